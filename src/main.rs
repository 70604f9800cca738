//! The `etude` program; all of it is in the library.

use std::process::ExitCode;

/// Tasks migrate between threads, so that memory is often freed on another thread than the one that allocated it. The C library's
/// allocator contends then.
#[cfg(all(target_os = "linux", target_env = "gnu", target_arch = "x86_64"))]
#[global_allocator]
static ALLOCATOR: tikv_jemallocator::Jemalloc = tikv_jemallocator::Jemalloc;

fn main() -> ExitCode {
    etude::cli::run()
}
