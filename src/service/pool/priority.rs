//! Which threads the operating system prefers while all processors are busy.

use std::cell::Cell;
use std::thread;

use tokio::runtime::Handle;
use tokio::sync::oneshot;

use super::PoolError;

/// How far a thread stands back behind those that talk to clients and to the disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Niceness {
    /// About a third of a normal thread's share while all processors are busy, and nine times that of a long job.
    Quick = 5,
    /// About a thirtieth of it: a thread that has an answer to send then preempts a search at once.
    Long = 15,
}

/// Lowers the priority of this thread for good: it cannot be raised again.
pub(super) fn give_way(niceness: Niceness) {
    thread_local! {
        static GIVEN: Cell<Option<Niceness>> = const { Cell::new(None) };
    }
    if GIVEN.get() < Some(niceness) {
        GIVEN.set(Some(niceness));
        #[cfg(target_os = "linux")]
        // On Linux each thread has its own priority. If it cannot be set, the thread only competes with the others.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), niceness as i32);
    }
}

/// Runs `work` on a thread that gives way so far: a new one for what is quick, as those that there are have given way further. What is returned
/// completes with what `work` gave, with an error if it panicked.
///
/// # Errors
///
/// [`PoolError::Busy`] if the system has no thread for it.
pub(super) fn run<T: Send + 'static>(
    niceness: Niceness,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<oneshot::Receiver<T>, PoolError> {
    let (sender, done) = oneshot::channel();
    let run = move || {
        give_way(niceness);
        // Whoever waited may be gone.
        let _ = sender.send(work());
    };
    match niceness {
        Niceness::Quick => {
            let runtime = Handle::current();
            let run = move || {
                let _entered = runtime.enter();
                run();
            };
            thread::Builder::new().name("quick".to_owned()).spawn(run).map_err(|_| PoolError::Busy)?;
        }
        Niceness::Long => drop(tokio::task::spawn_blocking(run)),
    }
    Ok(done)
}
