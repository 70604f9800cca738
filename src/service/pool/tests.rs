//! Who runs when, and who makes way for whom, on real threads.

use std::net::{IpAddr, Ipv4Addr};
use std::sync::atomic::Ordering;

use tokio::task::JoinHandle;

use super::place::MOMENT;
use super::priority::Niceness;
use super::*;
use crate::clock::thread_time;

fn client(n: u8) -> Client {
    IpAddr::from(Ipv4Addr::new(10, 0, 0, n)).into()
}

fn pool(n_threads: usize, max_waiting: usize) -> (SearchPool, CancellationToken) {
    let abort = CancellationToken::new();
    (
        SearchPool::new(
            PoolSettings { n_threads, max_waiting, max_long: n_threads + max_waiting },
            Clock::system(),
            TaskTracker::new(),
            abort.clone(),
        ),
        abort,
    )
}

fn until_cancelled(interrupt: &mut dyn Interrupt) -> Result<(), Cancelled> {
    loop {
        match interrupt.poll() {
            Signal::Cancel => return Err(Cancelled),
            Signal::Finish => return Ok(()),
            Signal::Continue => std::thread::yield_now(),
        }
    }
}

/// Keeps all threads of the pool until what it gives is dropped.
pub(in crate::service) async fn keep_all_threads(pool: &SearchPool) -> Vec<std::sync::mpsc::Sender<()>> {
    let n_threads = pool.0.searching.lines().turns.n_all();
    let mut kept = Vec::new();
    for _ in 0..n_threads {
        let (until, ends) = std::sync::mpsc::channel::<()>();
        let (begins, begun) = tokio::sync::oneshot::channel();
        let pool = pool.clone();
        tokio::spawn(async move {
            let job = move |_: &mut dyn Interrupt| {
                let _ = begins.send(());
                let _ = ends.recv();
                Ok(())
            };
            pool.run_in_turn(Client::LOCAL, job).await
        });
        begun.await.unwrap();
        kept.push(until);
    }
    kept
}

/// A job that is in the pool until it is cancelled.
async fn busy(pool: &SearchPool) -> JoinHandle<Result<(), PoolError>> {
    busy_as(pool, 0).await
}

async fn busy_as(pool: &SearchPool, n: u8) -> JoinHandle<Result<(), PoolError>> {
    let n_before = pool.n_jobs();
    let job = tokio::spawn({
        let pool = pool.clone();
        async move { pool.admit(client(n))?.run(None, until_cancelled).await }
    });
    while pool.n_jobs() == n_before {
        tokio::task::yield_now().await;
    }
    job
}

#[tokio::test]
async fn a_dropped_waiter_cancels_its_job_and_frees_the_thread() {
    let (pool, _abort) = pool(1, 0);
    let waiting = busy(&pool).await;
    waiting.abort();
    while pool.n_jobs() > 0 {
        tokio::task::yield_now().await;
    }
    assert_eq!(pool.admit(client(0)).unwrap().run(None, |_| Ok(7)).await, Ok(7));
}

#[tokio::test]
async fn a_full_queue_refuses_at_once_and_a_shutdown_stops_what_runs() {
    let (pool, abort) = pool(1, 1);
    let (first, second) = (pool.admit(client(0)).unwrap(), pool.admit(client(1)).unwrap());
    assert_eq!(pool.admit(client(2)).map(drop), Err(PoolError::Busy));
    let (first, second) = (first.run(None, until_cancelled), second.run(None, until_cancelled));
    let stop = async {
        abort.cancel();
    };
    let (first, second, ()) = tokio::join!(first, second, stop);
    assert_eq!((first, second), (Err(PoolError::Stopped), Err(PoolError::Stopped)));
}

#[tokio::test]
async fn a_job_that_runs_where_it_is_waits_for_nobody() {
    let (pool, abort) = pool(1, 3);
    for _ in 0..3 {
        busy(&pool).await;
    }
    assert_eq!(pool.run_here(None, |_| Ok(7)), Ok(7));
    assert_eq!(pool.run_here(Some(Clock::system().instant()), until_cancelled), Ok(()));
    abort.cancel();
    assert_eq!(pool.run_here(None, until_cancelled), Err(PoolError::Stopped));
}

/// Waits until so many jobs have become long.
async fn until_long(pool: &SearchPool, n_jobs: usize) {
    while pool.0.searching.lines().turns.n_long() < n_jobs {
        tokio::task::yield_now().await;
    }
}

#[tokio::test]
async fn a_small_job_is_done_while_any_number_of_large_ones_run() {
    let (pool, _abort) = pool(2, 30);
    for _ in 0..8 {
        busy(&pool).await;
    }
    for n in [0, 1] {
        let place = pool.admit(client(n)).unwrap();
        assert_eq!(place.run(None, |_| Ok(7)).await, Ok(7));
        assert_eq!(place.run_reading(1, || 7).await, Ok(7));
        assert_eq!(pool.run_in_turn(client(n), |_| Ok(7)).await, Ok(7));
    }
    until_long(&pool, 8).await;
    assert_eq!(pool.admit(client(0)).unwrap().run(None, |_| Ok(7)).await, Ok(7));
}

#[tokio::test]
async fn large_jobs_of_several_clients_go_on_in_turns() {
    let (pool, _abort) = pool(2, 30);
    let progress: Vec<Arc<AtomicU64>> = (0..3).map(|_| Arc::default()).collect();
    let mut running = tokio::task::JoinSet::new();
    for (n, progress) in (0..).zip(&progress) {
        let (pool, progress) = (pool.clone(), Arc::clone(progress));
        running.spawn(async move {
            let counting = move |interrupt: &mut dyn Interrupt| loop {
                progress.fetch_add(1, Ordering::Relaxed);
                if interrupt.poll() == Signal::Cancel {
                    return Err::<(), _>(Cancelled);
                }
            };
            pool.admit(client(n)).unwrap().run(None, counting).await
        });
    }
    until_long(&pool, 3).await;
    for _ in 0..3 {
        let before: Vec<u64> = progress.iter().map(|progress| progress.load(Ordering::Relaxed)).collect();
        while progress.iter().zip(&before).any(|(now, before)| now.load(Ordering::Relaxed) == *before) {
            // As something short comes all the time, they have one thread between them.
            pool.run_here(None, |_| Ok(())).unwrap();
            tokio::task::yield_now().await;
        }
    }
}

#[tokio::test]
async fn a_large_job_without_a_place_among_its_like_is_refused() {
    let (pool, _abort) = pool(1, 1);
    for n_long in 1..=2 {
        busy(&pool).await;
        until_long(&pool, n_long).await;
    }
    assert_eq!(pool.admit(client(0)).unwrap().run(None, until_cancelled).await, Err(PoolError::Busy));
}

#[tokio::test]
async fn a_job_that_has_made_way_finishes_in_time_all_the_same() {
    let (pool, _abort) = pool(1, 3);
    for n in 0..2 {
        busy_as(&pool, n).await;
    }
    until_long(&pool, 2).await;
    let place = pool.admit(client(2)).unwrap();
    let deadline = Clock::system().instant() + 10 * MOMENT;
    assert_eq!(place.clone().run(Some(deadline), until_cancelled).await, Ok(()));
    // Its request is long now, and would wait for the others.
    let impatient = place.waiting_until(Some(Clock::system().instant()));
    assert_eq!(impatient.run(Some(deadline), until_cancelled).await, Ok(()));
    assert_eq!(pool.n_jobs(), 3, "the others still run");
}

#[tokio::test]
async fn what_nobody_waits_for_makes_way_for_whoever_does() {
    let (pool, abort) = pool(2, 1);
    let spare = Box::pin(pool.run_to_spare(until_cancelled));
    let mut spare = std::pin::pin!(spare);
    assert!(futures_util::poll!(&mut spare).is_pending());
    assert_eq!(pool.run_to_spare(|_| Ok(())).await, Err(PoolError::Busy), "no other thread would be free");
    let running = busy(&pool).await;
    assert_eq!(pool.admit(client(0)).unwrap().run(None, |_| Ok(7)).await, Ok(7));
    assert_eq!(spare.await, Err(PoolError::Busy));
    running.abort();
    while pool.0.searching.lines().turns.n_running() > 0 {
        tokio::task::yield_now().await;
    }
    assert_eq!(pool.run_to_spare(|_| Ok(7)).await, Ok(7));
    abort.cancel();
    assert_eq!(pool.run_to_spare(until_cancelled).await, Err(PoolError::Stopped));
}

#[tokio::test]
async fn what_nobody_waits_for_leaves_a_thread_free() {
    let (pool, _abort) = pool(2, 0);
    let mut running = Box::pin(pool.run_in_turn(client(0), until_cancelled));
    assert!(futures_util::poll!(&mut running).is_pending());
    assert_eq!(pool.run_to_spare(|_| Ok(())).await, Err(PoolError::Busy));
    drop(running);
    // Its thread is free once it has seen that.
    while pool.0.searching.lines().turns.n_running() > 0 {
        tokio::task::yield_now().await;
    }
    let mut spare = Box::pin(pool.run_to_spare(until_cancelled));
    assert!(futures_util::poll!(&mut spare).is_pending());
    let mut running = Box::pin(pool.run_in_turn(client(0), until_cancelled));
    assert!(futures_util::poll!(&mut running).is_pending());
    assert_eq!(spare.await, Err(PoolError::Busy), "it had the last one for a while");
}

#[tokio::test]
async fn a_passed_deadline_asks_the_job_to_finish() {
    let (pool, _abort) = pool(1, 0);
    assert_eq!(pool.admit(client(0)).unwrap().run(Some(Clock::system().instant()), until_cancelled).await, Ok(()));
}

/// On Linux each thread has its own priority.
#[cfg(target_os = "linux")]
#[tokio::test]
async fn the_system_prefers_short_jobs_of_who_uses_little_to_those_of_others() {
    fn of_this_thread() -> i32 {
        rustix::process::getpriority_process(Some(rustix::thread::gettid())).unwrap()
    }
    let (pool, _abort) = pool(2, 2);
    let niceness = async |n| pool.admit(client(n)).unwrap().run(None, |_| Ok(of_this_thread())).await.unwrap();
    // Whatever the tests run with.
    let [quick, long] = [Niceness::Quick, Niceness::Long].map(|niceness| of_this_thread().max(niceness as i32));
    assert_eq!(niceness(0).await, quick);
    let now = Clock::system().instant();
    pool.0.searching.lines().turns.charge(client(0), Duration::from_secs(1), now);
    assert_eq!([niceness(0).await, niceness(1).await], [long, quick]);
    let until_long = move |interrupt: &mut dyn Interrupt| {
        while interrupt.poll() == Signal::Continue && of_this_thread() == quick {}
        Ok((of_this_thread(), thread_time() >= MOMENT))
    };
    assert_eq!(pool.admit(client(1)).unwrap().run(None, until_long).await, Ok((long, true)));
}
