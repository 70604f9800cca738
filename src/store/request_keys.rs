//! The table of keys that clients gave their requests, and what these have made.

use std::time::Duration;

use jiff::Timestamp;
use sqlx::SqliteConnection;

use super::writer::{Verb, Writing};
use super::{NewPolicy, NewRefinement, Store, StoreError, policies, refinements};

/// How long a key is kept: a day.
const KEPT_FOR: Duration = Duration::from_hours(24);

/// Most keys that are removed in one transaction, so that nobody waits long for it.
const MAX_REMOVED_AT_ONCE: u32 = 1000;

/// The key of a request.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct RequestKey {
    /// What is asked for: keys of one thing say nothing of another.
    pub scope: String,
    /// As the client gave it.
    pub key: String,
}

/// The key of a request that is answered for the first time.
#[derive(Clone, Debug)]
pub struct NewRequestKey {
    /// The key.
    pub key: RequestKey,
    /// SHA-256 of the request's body.
    pub body_hash: String,
    /// When the request came.
    pub at: Timestamp,
}

/// A request that was answered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AnsweredRequest {
    /// SHA-256 of its body.
    pub body_hash: String,
    /// The id of what it has made.
    pub made_id: String,
}

/// The key of a request is another one's already: nothing was done.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct KeyTaken;

/// Adds a policy that was asked for with a key.
#[derive(Debug)]
struct AddKeyedPolicy {
    key: NewRequestKey,
    policy: NewPolicy,
    refinement: Option<NewRefinement>,
}

/// Removes some of the keys that came up to this time.
#[derive(Debug)]
struct RemoveKeys(Timestamp);

impl Store {
    /// The request with this key that was answered within a day before `now`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn answered_request(
        &self,
        key: &RequestKey,
        now: Timestamp,
    ) -> Result<Option<AnsweredRequest>, StoreError> {
        let query = sqlx::query_as(
            "SELECT body_hash, made_id FROM request_keys WHERE scope = $1 AND key = $2 AND created_at_ms > $3",
        );
        let query = query.bind(&key.scope).bind(&key.key).bind(outdated(now).as_millisecond());
        let found: Option<(String, String)> = query.fetch_optional(&mut *self.reader().await?).await?;
        Ok(found.map(|(body_hash, made_id)| AnsweredRequest { body_hash, made_id }))
    }

    /// Stores a policy that was asked for with `key`, as [`Self::add_policies`] does, unless that is another request's.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_keyed_policy(
        &self,
        key: NewRequestKey,
        policy: NewPolicy,
        refinement: Option<NewRefinement>,
    ) -> Result<Result<(), KeyTaken>, StoreError> {
        self.writer.write(AddKeyedPolicy { key, policy, refinement }).await
    }

    /// Removes the keys that came more than a day before `now`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn remove_outdated_keys(&self, now: Timestamp) -> Result<(), StoreError> {
        while self.writer.write(RemoveKeys(outdated(now))).await? == u64::from(MAX_REMOVED_AT_ONCE) {}
        Ok(())
    }
}

/// Keys that came up to this time do not count any more.
fn outdated(now: Timestamp) -> Timestamp {
    now.checked_sub(KEPT_FOR).unwrap_or(Timestamp::MIN)
}

/// Notes that the request with this key has made what has this id, unless the key is another request's.
pub(super) async fn add(
    connection: &mut SqliteConnection,
    NewRequestKey { key, body_hash, at }: &NewRequestKey,
    made_id: &str,
) -> Result<Result<(), KeyTaken>, StoreError> {
    let added = sqlx::query(
        "INSERT INTO request_keys (scope, key, body_hash, made_id, created_at_ms) VALUES ($1, $2, $3, $4, $5)
         ON CONFLICT (scope, key) DO UPDATE
             SET body_hash = $3, made_id = $4, created_at_ms = $5 WHERE created_at_ms <= $6",
    );
    let added = added.bind(&key.scope).bind(&key.key).bind(body_hash).bind(made_id);
    let added = added.bind(at.as_millisecond()).bind(outdated(*at).as_millisecond());
    let was_added = added.execute(connection).await?.rows_affected() > 0;
    Ok(if was_added { Ok(()) } else { Err(KeyTaken) })
}

/// Forgets the request that has made what has this id, as that is gone.
pub(super) async fn forget(connection: &mut SqliteConnection, made_id: &str) -> Result<(), StoreError> {
    sqlx::query("DELETE FROM request_keys WHERE made_id = $1").bind(made_id).execute(connection).await?;
    Ok(())
}

impl Verb for AddKeyedPolicy {
    type Answer = Result<(), KeyTaken>;

    fn n_bytes(&self) -> usize {
        self.policy.n_bytes() + self.refinement.as_ref().map_or(0, NewRefinement::n_bytes)
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Result<(), KeyTaken>, StoreError> {
        let Self { key, policy, refinement } = self;
        let was_added = add(writing.connection().await?, key, &policy.id).await?;
        if was_added.is_ok() {
            policies::add_all(writing.statements, &[policy]).await?;
            if let Some(refinement) = refinement {
                refinements::add(writing.statements, refinement);
            }
        }
        Ok(was_added)
    }
}

impl Verb for RemoveKeys {
    type Answer = u64;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<u64, StoreError> {
        let removed = sqlx::query(
            "DELETE FROM request_keys WHERE sequence IN
                 (SELECT sequence FROM request_keys WHERE created_at_ms <= $1 ORDER BY created_at_ms LIMIT $2)",
        );
        let removed = removed.bind(self.0.as_millisecond()).bind(MAX_REMOVED_AT_ONCE);
        Ok(removed.execute(writing.connection().await?).await?.rows_affected())
    }
}

#[cfg(test)]
mod tests {
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::store::PolicyFilter;

    fn at(hour: i64) -> Timestamp {
        Timestamp::from_second(1_000_000 + 3600 * hour).unwrap()
    }

    fn key() -> RequestKey {
        RequestKey { scope: "policies".to_owned(), key: "k".to_owned() }
    }

    /// Stores the policy `id`, asked for with the key at this hour.
    async fn add(store: &Store, id: &str, hour: i64) -> Result<(), KeyTaken> {
        let policy = NewPolicy::plain(id, "{}", at(hour));
        let key = NewRequestKey { key: key(), body_hash: format!("hash of {id}"), at: at(hour) };
        store.add_keyed_policy(key, policy, None).await.unwrap()
    }

    async fn made(store: &Store, hour: i64) -> Option<String> {
        store.answered_request(&key(), at(hour)).await.unwrap().map(|answered| answered.made_id)
    }

    #[tokio::test]
    async fn a_key_stands_for_a_request_for_a_day_and_for_another_one_after_that() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
        assert_eq!(add(&store, "a", 0).await, Ok(()));
        assert_eq!((made(&store, 23).await, made(&store, 24).await), (Some("a".to_owned()), None));
        assert_eq!(add(&store, "b", 23).await, Err(KeyTaken));
        assert_eq!(store.policies(&PolicyFilter::default(), 0, 10).await.unwrap().items.len(), 1, "nothing was done");
        assert_eq!(add(&store, "c", 24).await, Ok(()));
        assert_eq!(made(&store, 47).await.as_deref(), Some("c"));
        store.remove_outdated_keys(at(47)).await.unwrap();
        assert_eq!(made(&store, 47).await.as_deref(), Some("c"));
        store.remove_outdated_keys(at(48)).await.unwrap();
        assert_eq!(made(&store, 24).await, None, "it is gone");
        assert_eq!(store.policies(&PolicyFilter::default(), 0, 10).await.unwrap().items.len(), 2, "the policies stay");
    }
}
