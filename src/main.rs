//! The `etude` program.

fn main() {}
