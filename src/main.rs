//! The `etude` program; all of it is in the library.

use std::process::ExitCode;

/// What a task allocates, another thread may free, as tasks go on wherever there is time for them. That of the C library makes both
/// threads wait for each other then.
#[cfg(all(target_os = "linux", target_env = "gnu", target_arch = "x86_64"))]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    etude::cli::run()
}
