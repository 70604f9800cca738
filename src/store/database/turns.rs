//! Who reads next: clients in turn.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use tokio::sync::oneshot;

use crate::client::{Client, Lines};

/// A few turns, for which clients wait in lines.
#[derive(Clone, Debug)]
pub(super) struct Turns(Arc<Mutex<State>>);

#[derive(Debug)]
struct State {
    /// Turns that nobody has. If there are any, nobody waits.
    n_free: u32,
    waiting: Lines<oneshot::Sender<Turn>>,
}

/// Somebody's turn, until this is dropped.
#[derive(Debug)]
pub(super) struct Turn(Option<Turns>);

impl Turns {
    pub(super) fn new(n_free: u32) -> Self {
        Self(Arc::new(Mutex::new(State { n_free, waiting: Lines::new() })))
    }

    /// Takes a turn of `client`, once it comes.
    pub(super) async fn take(&self, client: Client) -> Turn {
        let coming = {
            let mut state = self.state();
            if state.n_free > 0 {
                state.n_free -= 1;
                return Turn(Some(self.clone()));
            }
            let (pass, coming) = oneshot::channel();
            state.waiting.line_up(client, pass);
            coming
        };
        // Whoever has a turn passes it on.
        coming.await.unwrap_or(Turn(None))
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let Some(turns) = self.0.take() else { return };
        let next = {
            let mut state = turns.state();
            let next = state.waiting.next();
            state.n_free += u32::from(next.is_none());
            next
        };
        if let Some(next) = next {
            // Where nobody waits there any more, it comes back by being dropped.
            let _ = next.send(Self(Some(turns)));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::IpAddr;
    use std::pin::pin;

    use futures_util::poll;

    use super::*;

    fn client(n: u8) -> Client {
        IpAddr::from([10, 0, 0, n]).into()
    }

    #[tokio::test]
    async fn a_client_that_comes_after_many_of_another_one_is_next() {
        let turns = Turns::new(2);
        let (first, second) = (turns.take(client(0)).await, turns.take(client(0)).await);
        let mut many: Vec<_> = (0..100).map(|_| Box::pin(turns.take(client(0)))).collect();
        for waiting in &mut many {
            assert!(poll!(waiting).is_pending());
        }
        let mut other = pin!(turns.take(client(1)));
        assert!(poll!(&mut other).is_pending());
        drop(first);
        let third = many.remove(0).await;
        drop(second);
        let fourth = other.await;
        drop((third, fourth));
        for waiting in many {
            drop(waiting.await);
        }
        assert_eq!(turns.state().n_free, 2);
    }

    #[tokio::test]
    async fn the_turn_of_who_has_gone_is_somebody_elses() {
        let turns = Turns::new(1);
        let turn = turns.take(client(0)).await;
        let mut waiting: Vec<_> = (0..100).map(|n| Box::pin(turns.take(client(n % 7)))).collect();
        for waiting in &mut waiting {
            assert!(poll!(waiting).is_pending());
        }
        let last = waiting.pop().unwrap();
        // One of them is told, and goes without having looked.
        drop(turn);
        drop(waiting);
        drop(last.await);
        assert_eq!(turns.state().n_free, 1);
    }
}
