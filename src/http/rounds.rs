//! Who is served next: in rounds, one task of each client after another.
//!
//! A runtime polls tasks in the order in which they were woken, so that whoever comes after a hundred connections of somebody else waits for all
//! of them. So only a few tasks of connections are with the runtime at a time; the others wait here, those of a client in a line of their own.
//!
//! ```text
//! woken -> is a turn free? -- yes -> with the runtime -> polled -> its turn goes to the next client that has a line
//!               |                                                         |
//!               +-- no --> last in the line of its client <-- woken meanwhile, and somebody waits
//! ```
//!
//! A task that was woken while it ran is polled again at once if nobody waits: the parts of a stream wake one another, and a runtime would put it
//! behind all others, and wake another thread to look after them.

use std::pin::Pin;
use std::sync::atomic::{AtomicU8, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll, Wake, Waker};

use futures_util::task::AtomicWaker;

use crate::client::{Client, Lines};

/// Tasks that are with the runtime at a time, for each of its threads: one that runs, and one that is there when that is done.
const TURNS_PER_THREAD: usize = 2;

/// Most polls in a row of a task that is woken while it runs.
const MAX_POLLS: usize = 4;

/// Nothing has woken it.
const IDLE: u8 = 0;
/// It waits for its turn.
const WAITING: u8 = 1;
/// It has a turn, and is with the runtime.
const GRANTED: u8 = 2;
/// It runs.
const RUNNING: u8 = 3;
/// It runs, and was woken since.
const AGAIN: u8 = 4;
/// It has ended.
const OVER: u8 = 5;

/// Serves clients in rounds.
#[derive(Clone, Debug)]
pub struct Rounds(Arc<Mutex<State>>);

#[derive(Debug)]
struct State {
    /// Turns that nobody has. If there are any, nobody waits.
    n_free: usize,
    waiting: Lines<Arc<Task>>,
}

impl State {
    /// Passes a turn on. Gives whom the runtime is to be told of.
    fn pass_on(&mut self) -> Option<Arc<Task>> {
        while let Some(next) = self.waiting.next() {
            // Some have ended while they waited.
            if next.moves(WAITING, GRANTED) {
                return Some(next);
            }
        }
        self.n_free += 1;
        None
    }
}

impl Rounds {
    /// Rounds on a runtime of so many threads.
    #[must_use]
    pub fn new(n_threads: usize) -> Self {
        let n_free = TURNS_PER_THREAD * n_threads.max(1);
        Self(Arc::new(Mutex::new(State { n_free, waiting: Lines::new() })))
    }

    /// Runs `future`, which serves `client`, whenever it is its turn: from now on it waits for the first one.
    pub(super) fn run<F: Future>(&self, client: Client, future: F) -> InTurn<F> {
        let state = AtomicU8::new(WAITING);
        let task = Arc::new(Task { client, rounds: self.clone(), state, runtime: AtomicWaker::new() });
        let is_queued = !task.take_turn();
        InTurn { waker: Waker::from(Arc::clone(&task)), task, is_queued, future: Box::pin(future) }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Passes the turn of a task on.
    fn pass_on(&self) {
        let next = self.state().pass_on();
        if let Some(next) = next {
            next.runtime.wake();
        }
    }
}

/// A task that serves a client.
#[derive(Debug)]
struct Task {
    client: Client,
    rounds: Rounds,
    state: AtomicU8,
    /// Wakes it in the runtime.
    runtime: AtomicWaker,
}

impl Task {
    /// Changes its state, if that is `from`. Says whether it did.
    fn moves(&self, from: u8, to: u8) -> bool {
        self.state.compare_exchange(from, to, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }

    /// Takes a turn for it, or has it line up where none is free. Says whether it has one.
    fn take_turn(self: &Arc<Self>) -> bool {
        let mut rounds = self.rounds.state();
        if rounds.n_free == 0 {
            rounds.waiting.line_up(self.client, Arc::clone(self));
            return false;
        }
        let has_turn = self.moves(WAITING, GRANTED);
        rounds.n_free -= usize::from(has_turn);
        has_turn
    }

    /// Whether it goes on at once after it was woken while it ran; else it waits for another turn.
    fn goes_on(self: &Arc<Self>, n_polls: usize) -> bool {
        let mut rounds = self.rounds.state();
        if n_polls < MAX_POLLS && rounds.waiting.is_empty() {
            return self.moves(AGAIN, RUNNING);
        }
        self.state.swap(WAITING, Ordering::AcqRel);
        rounds.waiting.line_up(self.client, Arc::clone(self));
        let next = rounds.pass_on();
        drop(rounds);
        if let Some(next) = next {
            next.runtime.wake();
        }
        false
    }
}

impl Wake for Task {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // Written also where nothing changes, so that whoever polls it sees what it is woken for.
        let before = self.state.fetch_update(Ordering::AcqRel, Ordering::Acquire, |state| {
            Some(match state {
                IDLE => WAITING,
                RUNNING => AGAIN,
                to_be_polled_or_over => to_be_polled_or_over,
            })
        });
        if before == Ok(IDLE) && self.take_turn() {
            self.runtime.wake();
        }
    }
}

/// A future that is polled in its turn.
pub(super) struct InTurn<F> {
    task: Arc<Task>,
    waker: Waker,
    /// Whether it waited for its first turn when it was given to the runtime, which then polls it before whoever is granted a turn earlier.
    is_queued: bool,
    future: Pin<Box<F>>,
}

impl<F: Future> Future for InTurn<F> {
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<F::Output> {
        let Self { task, waker, is_queued, future } = &mut *self;
        task.runtime.register(context.waker());
        if std::mem::take(is_queued) {
            // If it was granted a turn meanwhile, it goes behind those who were granted one before.
            if task.state.load(Ordering::Acquire) == GRANTED {
                context.waker().wake_by_ref();
            }
            return Poll::Pending;
        }
        if !task.moves(GRANTED, RUNNING) {
            return Poll::Pending;
        }
        for n_polls in 1.. {
            let polled = task.client.serve(|| future.as_mut().poll(&mut Context::from_waker(waker)));
            if let Poll::Ready(output) = polled {
                task.state.store(OVER, Ordering::Release);
                task.rounds.pass_on();
                return Poll::Ready(output);
            }
            if task.moves(RUNNING, IDLE) {
                task.rounds.pass_on();
                break;
            }
            if !task.goes_on(n_polls) {
                break;
            }
        }
        Poll::Pending
    }
}

/// A turn that it has goes to another one.
impl<F> Drop for InTurn<F> {
    fn drop(&mut self) {
        if let GRANTED | RUNNING | AGAIN = self.task.state.swap(OVER, Ordering::AcqRel) {
            self.task.rounds.pass_on();
        }
    }
}

#[cfg(test)]
mod tests {
    use std::future::poll_fn;
    use std::net::{IpAddr, Ipv4Addr};
    use std::pin::pin;
    use std::sync::atomic::AtomicUsize;

    use tokio::sync::mpsc;
    use tokio::task::JoinSet;

    use super::*;

    fn client(n: u8) -> Client {
        IpAddr::from(Ipv4Addr::new(10, 0, 0, n)).into()
    }

    /// Counts how often the runtime is told.
    #[derive(Debug, Default)]
    struct Told(AtomicUsize);

    impl Wake for Told {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::SeqCst);
        }
    }

    impl Told {
        /// How often since it was asked last.
        fn take(&self) -> usize {
            self.0.swap(0, Ordering::SeqCst)
        }
    }

    fn poll<F: Future>(task: &mut InTurn<F>, told: &Arc<Told>) -> Poll<F::Output> {
        pin!(task).poll(&mut Context::from_waker(&Waker::from(Arc::clone(told))))
    }

    /// A runtime without threads: tasks are polled in the order in which they were woken.
    #[tokio::test]
    async fn somebody_who_comes_after_many_tasks_of_another_client_waits_for_few_of_them() {
        const MANY: usize = 100;
        let (rounds, polled) = (Rounds::new(1), Arc::new(Mutex::new(Vec::new())));
        let (wake, _) = tokio::sync::broadcast::channel::<()>(1);
        let mut tasks = JoinSet::new();
        for n in 0..=MANY {
            let (polled, mut woken) = (Arc::clone(&polled), wake.subscribe());
            let client = client(u8::from(n == MANY));
            tasks.spawn(rounds.run(client, async move {
                polled.lock().unwrap().push(n);
                woken.recv().await.unwrap();
                polled.lock().unwrap().push(n);
            }));
        }
        for _ in 0..2 {
            while polled.lock().unwrap().len() <= MANY {
                tokio::task::yield_now().await;
            }
            let order = std::mem::take(&mut *polled.lock().unwrap());
            assert!(order.iter().position(|n| *n == MANY).unwrap() <= TURNS_PER_THREAD + 1, "{order:?}");
            let first: Vec<usize> = order.iter().copied().filter(|n| *n < MANY).collect();
            assert!(first.is_sorted(), "those of a client come in their order: {first:?}");
            let _ = wake.send(());
        }
        while tasks.join_next().await.is_some() {}
        assert_eq!(rounds.state().n_free, TURNS_PER_THREAD);
    }

    #[test]
    fn parts_that_wake_one_another_go_on_without_the_runtime() {
        let (rounds, told) = (Rounds::new(1), Arc::new(Told::default()));
        let ((to_last, mut last), (to_first, mut first)) = (mpsc::unbounded_channel(), mpsc::unbounded_channel());
        let (from_outside, mut outside) = mpsc::unbounded_channel();
        let mut task = rounds.run(client(0), async {
            let last = async {
                while let Some(n) = last.recv().await {
                    to_first.send(n + 1).unwrap();
                }
            };
            let first = async {
                while let Some(n) = outside.recv().await {
                    to_last.send(n).unwrap();
                    assert_eq!(first.recv().await, Some(n + 1));
                }
            };
            // What the last does for the first is seen when both are polled again.
            tokio::select! {
                biased;
                () = first => {}
                () = last => {}
            }
        });
        assert!(poll(&mut task, &told).is_pending());
        for n in 0..3 {
            from_outside.send(n).unwrap();
            assert_eq!(told.take(), 1, "who waits for something from outside hears of it");
            assert!(poll(&mut task, &told).is_pending());
            assert_eq!(told.take(), 0);
        }
        drop(from_outside);
        assert_eq!(told.take(), 1);
        assert!(poll(&mut task, &told).is_ready());
    }

    #[test]
    fn what_wakes_itself_for_ever_lets_others_go_on() {
        let (rounds, told) = (Rounds::new(1), Arc::new(Told::default()));
        let n_polls = AtomicUsize::new(0);
        let mut restless = rounds.run(
            client(0),
            poll_fn(|context| {
                n_polls.fetch_add(1, Ordering::SeqCst);
                context.waker().wake_by_ref();
                Poll::<()>::Pending
            }),
        );
        for _ in 0..2 {
            assert!(poll(&mut restless, &told).is_pending());
            assert_eq!((n_polls.swap(0, Ordering::SeqCst), told.take()), (MAX_POLLS, 1));
        }
        // All other turns are taken by one who does not come for it, and another one of the same client waits.
        let _others: Vec<_> = (1..TURNS_PER_THREAD).map(|_| rounds.run(client(1), async {})).collect();
        let mut waiting = rounds.run(client(0), async {});
        let others_told = Arc::new(Told::default());
        assert!(poll(&mut waiting, &others_told).is_pending());
        assert!(poll(&mut restless, &told).is_pending());
        assert_eq!((n_polls.swap(0, Ordering::SeqCst), told.take(), others_told.take()), (1, 0, 1));
        assert!(poll(&mut restless, &told).is_pending(), "it is not its turn");
        assert_eq!(n_polls.load(Ordering::SeqCst), 0);
        assert!(poll(&mut waiting, &others_told).is_ready());
        assert_eq!(told.take(), 1);
    }

    #[test]
    fn who_ends_before_its_turn_keeps_none() {
        let rounds = Rounds::new(1);
        let tasks: Vec<_> = (0..10).map(|n| rounds.run(client(n % 3), async {})).collect();
        let mut last = rounds.run(client(0), async {});
        let told = Arc::new(Told::default());
        assert!(poll(&mut last, &told).is_pending());
        drop(tasks);
        assert_eq!(told.take(), 1);
        assert!(poll(&mut last, &told).is_ready());
        let state = rounds.state();
        assert!(state.n_free == TURNS_PER_THREAD && state.waiting.is_empty());
    }

    #[tokio::test(flavor = "multi_thread", worker_threads = 3)]
    async fn nobody_is_forgotten_however_many_threads_wake_them() {
        const N_TASKS: u8 = 40;
        const N_MESSAGES: u32 = 2000;
        let rounds = Rounds::new(1);
        let mut tasks = JoinSet::new();
        let (first, mut received) = mpsc::channel(1);
        // A chain, each of which passes on what comes, and asks for it anew now and then.
        for n in 0..N_TASKS {
            let (next, next_received) = mpsc::channel(1);
            let mut received = std::mem::replace(&mut received, next_received);
            tasks.spawn(rounds.run(client(n % 7), async move {
                while let Some(message) = received.recv().await {
                    if message % u32::from(n + 2) == 0 {
                        tokio::task::yield_now().await;
                    }
                    if next.send(message).await.is_err() {
                        return;
                    }
                }
            }));
        }
        tokio::spawn(async move {
            for n in 0..N_MESSAGES {
                first.send(n).await.unwrap();
            }
        });
        for n in 0..N_MESSAGES {
            assert_eq!(received.recv().await, Some(n));
        }
        assert_eq!(received.recv().await, None);
        while tasks.join_next().await.is_some() {}
        assert_eq!(rounds.state().n_free, TURNS_PER_THREAD);
    }
}
