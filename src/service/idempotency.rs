//! Requests that a client may repeat: it gives each a key of its own, and one that comes again is answered as it was.
//!
//! ```text
//! key --> one at a time --> answered before? --same body--> what it has made, as it was then
//!                                |           --another----> refused
//!                                +--no--> search --> store: what is made and the key, in one transaction
//! ```
//!
//! Only requests that made something are remembered, for a day; what failed may be tried again.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use jiff::Timestamp;
use tokio::sync::OwnedMutexGuard;
use tokio_util::bytes::Bytes;

use super::hash::hash_of;
use super::search::MAX_INLINE_BYTES;
use super::{Caller, Etude, PoolError, ServiceError};
use crate::store::{AnsweredRequest, NewRequestKey, RequestKey};

/// A key that a client gave a request (`Idempotency-Key`): 1 to 255 visible ASCII characters.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct IdempotencyKey(String);

/// A text is no [`IdempotencyKey`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected 1 to 255 visible ASCII characters")]
pub struct InvalidIdempotencyKey;

impl IdempotencyKey {
    /// Longest key, in characters.
    pub const MAX_CHARS: usize = 255;

    /// Checks a key.
    ///
    /// # Errors
    ///
    /// [`InvalidIdempotencyKey`] if `text` is empty, longer than [`Self::MAX_CHARS`], or has other characters.
    pub fn new(text: &[u8]) -> Result<Self, InvalidIdempotencyKey> {
        let is_valid = (1..=Self::MAX_CHARS).contains(&text.len()) && text.iter().all(u8::is_ascii_graphic);
        let text = std::str::from_utf8(text).ok().filter(|_| is_valid);
        text.map(|text| Self(text.to_owned())).ok_or(InvalidIdempotencyKey)
    }
}

/// Keys of requests that are under way.
#[derive(Debug, Default)]
pub(super) struct Turns(Arc<Mutex<HashMap<RequestKey, Arc<tokio::sync::Mutex<()>>>>>);

/// The only request under way with its key, until it is dropped.
#[derive(Debug)]
pub(super) struct Turn {
    key: RequestKey,
    turns: Turns,
    /// `None` while it is waited for.
    alone: Option<OwnedMutexGuard<()>>,
}

impl Turns {
    /// Waits for the requests with this key that came before.
    async fn take(&self, key: &RequestKey) -> Turn {
        // Who stops waiting leaves nothing behind either.
        let mut turn = Turn { key: key.clone(), turns: Self(Arc::clone(&self.0)), alone: None };
        let waiting = {
            let mut keys = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            Arc::clone(keys.entry(key.clone()).or_default()).lock_owned()
        };
        turn.alone = Some(waiting.await);
        turn
    }
}

impl Drop for Turn {
    fn drop(&mut self) {
        let mut keys = self.turns.0.lock().unwrap_or_else(PoisonError::into_inner);
        self.alone = None;
        if keys.get(&self.key).is_some_and(|key| Arc::strong_count(key) == 1) {
            keys.remove(&self.key);
        }
    }
}

/// A request with a key that makes something now.
pub(super) struct First {
    /// To be stored with what is made.
    pub(super) key: NewRequestKey,
    /// So that nobody else does.
    _turn: Turn,
}

/// What becomes of a request with a key.
pub(super) enum Repeat {
    /// It is to be done.
    First(First),
    /// It made what has this id.
    Answered(String),
}

impl Etude {
    /// Whether the request with this body, whose key is of this `scope`, was answered before. Waits for those that came before with the
    /// same key.
    ///
    /// # Errors
    ///
    /// [`ServiceError::KeyReused`] if one with another body was answered; if the service cannot do it now.
    pub(super) async fn repeat(
        &self,
        scope: String,
        IdempotencyKey(key): &IdempotencyKey,
        body: &Bytes,
        caller: Caller,
    ) -> Result<Repeat, ServiceError> {
        let body_hash = if body.len() <= MAX_INLINE_BYTES {
            hash_of(body)
        } else {
            let text = body.clone();
            self.pool.read_in_turn(caller.client, body.len(), move || hash_of(&text)).await?
        };
        let key = RequestKey { scope, key: key.clone() };
        let turn = self.turns.take(&key).await;
        Ok(match self.answered(&key, &body_hash, caller.now).await? {
            Some(made_id) => Repeat::Answered(made_id),
            None => Repeat::First(First { key: NewRequestKey { key, body_hash, at: caller.now }, _turn: turn }),
        })
    }

    /// What was made by a request whose key was taken while this one was under way: the client of the first one went away before it was
    /// stored.
    pub(super) async fn made_meanwhile(&self, key: &NewRequestKey) -> Result<String, ServiceError> {
        let made = self.answered(&key.key, &key.body_hash, key.at).await?;
        made.ok_or_else(|| PoolError::Busy.into())
    }

    /// The id of what the request with this key and body has made.
    async fn answered(&self, key: &RequestKey, hash: &str, now: Timestamp) -> Result<Option<String>, ServiceError> {
        match self.store.answered_request(key, now).await? {
            Some(AnsweredRequest { body_hash, made_id }) if body_hash == hash => Ok(Some(made_id)),
            Some(_) => Err(ServiceError::KeyReused { key: key.key.clone() }),
            None => Ok(None),
        }
    }
}

#[cfg(test)]
mod tests {
    use futures_util::poll;

    use super::*;

    #[test]
    fn a_key_has_1_to_255_visible_characters() {
        for key in ["a", "\"8e03978e-40d5-43dd-bc93-6894a57f9324\"", "~!", &"k".repeat(255)] {
            assert_eq!(IdempotencyKey::new(key.as_bytes()), Ok(IdempotencyKey(key.to_owned())));
        }
        for key in ["", "a b", "\t", "ü", "\u{7f}", &"k".repeat(256)] {
            assert_eq!(IdempotencyKey::new(key.as_bytes()), Err(InvalidIdempotencyKey), "{key}");
        }
    }

    #[tokio::test]
    async fn requests_with_one_key_come_one_after_the_other_and_leave_nothing_behind() {
        let turns = Turns::default();
        let key = |key: &str| RequestKey { scope: "s".to_owned(), key: key.to_owned() };
        let (a, b) = (key("a"), key("b"));
        let first = turns.take(&a).await;
        let other = turns.take(&b).await;
        let mut second = Box::pin(turns.take(&a));
        let mut third = Box::pin(turns.take(&a));
        assert!(poll!(&mut second).is_pending() && poll!(&mut third).is_pending());
        drop(second);
        assert!(poll!(&mut third).is_pending(), "the first is still under way");
        drop(first);
        drop((third.await, other));
        assert_eq!(turns.0.lock().unwrap().len(), 0);
        let first = turns.take(&a).await;
        let mut second = Box::pin(turns.take(&a));
        assert!(poll!(&mut second).is_pending());
        drop(first);
        drop(second);
        assert_eq!(turns.0.lock().unwrap().len(), 0);
    }
}
