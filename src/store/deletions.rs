//! Deletion of policies, trials and sessions, one by one, with what hangs on them: each in one transaction.
//!
//! | deleted | what goes with it | what loses its link | what keeps it |
//! |---|---|---|---|
//! | policy | its refinement, if that waits, and the key of its request | the policy that it refines, the one that refines it, its session | a trial that it is of |
//! | trial | the key of its request | the session that explores it | its reward |
//! | session | its observations and steps, and the refinement of its policy that waits for them | | |
//!
//! A trial's policy stays, and so do the policy and the trial of a session.

use sqlx::Row;

use super::writer::{Verb, Writing};
use super::{Deletion, Store, StoreError, policies, request_keys};

/// Something else needs what was to be deleted: it was left alone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Needed;

/// Deletes the policy with this id.
#[derive(Debug)]
struct DeletePolicy(String);

/// Deletes the trial with this id.
#[derive(Debug)]
struct DeleteTrial(String);

/// Deletes the session with this id.
#[derive(Debug)]
struct DeleteSession(String);

impl Store {
    /// Deletes a policy, unless a trial needs it.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn delete_policy(&self, id: &str) -> Result<Result<Deletion, Needed>, StoreError> {
        self.writer.write(DeletePolicy(id.to_owned())).await
    }

    /// Deletes a trial, unless it has a reward, from which its learner learns. No other trial is ever given its number.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn delete_trial(&self, id: &str) -> Result<Result<Deletion, Needed>, StoreError> {
        self.writer.write(DeleteTrial(id.to_owned())).await
    }

    /// Deletes a session, running or not. Nothing more is accepted for it.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn delete_session(&self, id: &str) -> Result<Deletion, StoreError> {
        self.writer.write(DeleteSession(id.to_owned())).await
    }
}

impl Verb for DeletePolicy {
    type Answer = Result<Deletion, Needed>;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Result<Deletion, Needed>, StoreError> {
        let (Self(id), connection) = (self, writing.connection().await?);
        // What is damaged can be deleted too.
        let deleted = sqlx::query(
            "DELETE FROM policies WHERE id = $1 AND NOT EXISTS (SELECT 1 FROM trials WHERE policy_id = $1)
             RETURNING IIF(json_valid(summary), summary ->> 'refines', NULL) AS refines, refined_by",
        );
        let Some(row) = deleted.bind(id).fetch_optional(&mut *connection).await? else {
            let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM policies WHERE id = $1)");
            let is_there = query.bind(id).fetch_one(connection).await?;
            return Ok(if is_there { Err(Needed) } else { Ok(Deletion::Unknown) });
        };
        if let Some(refined) = row.try_get::<Option<String>, _>("refines")? {
            let unlinked = sqlx::query("UPDATE policies SET refined_by = NULL WHERE id = $1 AND refined_by = $2");
            unlinked.bind(refined).bind(id).execute(&mut *connection).await?;
        }
        if let Some(refined_by) = row.try_get::<Option<String>, _>("refined_by")? {
            policies::forget_refined(connection, &refined_by, id).await?;
        }
        request_keys::forget(connection, id).await?;
        for query in [
            "DELETE FROM refinements WHERE policy_id = $1",
            "UPDATE sessions SET policy_id = NULL WHERE policy_id = $1",
        ] {
            sqlx::query(query).bind(id).execute(&mut *connection).await?;
        }
        Ok(Ok(Deletion::Deleted))
    }
}

impl Verb for DeleteTrial {
    type Answer = Result<Deletion, Needed>;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Result<Deletion, Needed>, StoreError> {
        let (Self(id), connection) = (self, writing.connection().await?);
        let deleted = sqlx::query_as::<_, (i64, i64)>(
            "DELETE FROM trials WHERE id = $1 AND NOT EXISTS (SELECT 1 FROM rewards WHERE trial = trials.sequence)
             RETURNING learner, number",
        );
        let Some((learner, number)) = deleted.bind(id).fetch_optional(&mut *connection).await? else {
            let query = sqlx::query_scalar("SELECT EXISTS (SELECT 1 FROM trials WHERE id = $1)");
            let is_there = query.bind(id).fetch_one(connection).await?;
            return Ok(if is_there { Err(Needed) } else { Ok(Deletion::Unknown) });
        };
        request_keys::forget(connection, id).await?;
        let noted = sqlx::query("UPDATE learners SET deleted_number = MAX(deleted_number, $2) WHERE sequence = $1");
        noted.bind(learner).bind(number).execute(&mut *connection).await?;
        let unlinked = sqlx::query("UPDATE sessions SET trial_id = NULL WHERE trial_id = $1");
        unlinked.bind(id).execute(connection).await?;
        Ok(Ok(Deletion::Deleted))
    }
}

impl Verb for DeleteSession {
    type Answer = Deletion;

    /// So that none of them is left to be settled.
    const READS_OBSERVATIONS: bool = true;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Deletion, StoreError> {
        let (Self(id), connection) = (self, writing.connection().await?);
        let deleted = sqlx::query_scalar("DELETE FROM sessions WHERE id = $1 RETURNING policy_id").bind(id);
        let Some(policy_id) = deleted.fetch_optional(&mut *connection).await? else { return Ok(Deletion::Unknown) };
        for query in [
            "DELETE FROM observations WHERE session_id = $1",
            "DELETE FROM steps WHERE session_id = $1",
            "DELETE FROM roots WHERE session_id = $1",
        ] {
            sqlx::query(query).bind(id).execute(&mut *connection).await?;
        }
        let policy_id: Option<String> = policy_id;
        if let Some(policy_id) = policy_id {
            let given_up = sqlx::query("DELETE FROM refinements WHERE policy_id = $1 AND session_id = $2");
            given_up.bind(policy_id).bind(id).execute(connection).await?;
        }
        writing.arrivals.ended(id);
        Ok(Deletion::Deleted)
    }
}
