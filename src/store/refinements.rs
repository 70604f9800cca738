//! The table of policies that wait to be refined.

use sqlx::Row;

use super::policies::{self, NewPolicy, NewRefinement};
use super::statements::Statements;
use super::writer::{Verb, Writing};
use super::{Store, StoreError};

/// Most attempts at a refinement. One during which the process ended so many times may be what ends it, and is given up.
pub const MAX_ATTEMPTS: u32 = 3;

/// The end of a refinement.
#[derive(Clone, Debug)]
pub struct RefinementEnd {
    /// The policy that was to be refined.
    pub policy_id: String,
    /// The refined policy; `None` if there can be none any more.
    pub refined: Option<NewPolicy>,
}

/// Whether a refinement may be attempted.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Attempt {
    /// It may, and this attempt is counted.
    Begun,
    /// There were [`MAX_ATTEMPTS`] already. Nothing of it is left.
    GivenUp,
    /// It does not wait any more: its policy was deleted, or the session that has what was observed.
    Gone,
}

/// Counts one more attempt at the refinement of this policy.
#[derive(Debug)]
struct BeginRefinement(String);

/// Takes an attempt at the refinement of this policy back.
#[derive(Debug)]
struct ReturnRefinement(String);

impl Store {
    /// The refinement that has waited longest of those after the sequence number `after`, with its own.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn next_refinement(&self, after: i64) -> Result<Option<(i64, NewRefinement)>, StoreError> {
        let query = sqlx::query(
            "SELECT rowid AS sequence, policy_id, model_hash, session_id, request FROM refinements WHERE rowid > $1
             ORDER BY rowid LIMIT 1",
        );
        let Some(row) = query.bind(after).fetch_optional(&mut *self.reader().await?).await? else { return Ok(None) };
        let refinement = NewRefinement {
            policy_id: row.try_get("policy_id")?,
            model_hash: row.try_get("model_hash")?,
            session_id: row.try_get("session_id")?,
            request: row.try_get("request")?,
        };
        Ok(Some((row.try_get("sequence")?, refinement)))
    }

    /// Begins another attempt at a refinement: durable, so that it counts whatever becomes of the process.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn begin_refinement(&self, policy_id: &str) -> Result<Attempt, StoreError> {
        self.writer.write(BeginRefinement(policy_id.to_owned())).await
    }

    /// Takes back an attempt that was ended for another reason than the refinement itself.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn return_refinement(&self, policy_id: &str) -> Result<(), StoreError> {
        self.writer.write(ReturnRefinement(policy_id.to_owned())).await
    }

    /// How often the refinement of this policy was taken up, if it waits.
    #[cfg(test)]
    pub(crate) async fn n_attempts(&self, policy_id: &str) -> Option<u32> {
        let query = sqlx::query_scalar("SELECT attempts FROM refinements WHERE policy_id = $1").bind(policy_id);
        query.fetch_optional(&mut *self.reader().await.unwrap()).await.unwrap()
    }

    /// Stores a refined policy and links the two.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing was stored.
    pub async fn end_refinement(&self, end: RefinementEnd) -> Result<(), StoreError> {
        self.writer.write(end).await
    }
}

pub(super) fn add(statements: &mut Statements<'_>, refinement: &NewRefinement) {
    let NewRefinement { policy_id, model_hash, session_id, request } = refinement;
    statements
        .add("INSERT INTO refinements (policy_id, model_hash, session_id, request) VALUES (?, ?, ?, ?)")
        .bind(policy_id)
        .bind(model_hash)
        .bind(session_id)
        .bind(request);
}

impl Verb for RefinementEnd {
    type Answer = ();

    fn n_bytes(&self) -> usize {
        self.refined.as_ref().map_or(0, NewPolicy::n_bytes)
    }

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<(), StoreError> {
        writing.statements.add("DELETE FROM refinements WHERE policy_id = ? RETURNING policy_id").bind(&self.policy_id);
        let was_waiting = writing.statements.fetch().await?.is_some();
        let (true, Some(refined)) = (was_waiting, &self.refined) else { return Ok(()) };
        policies::add_all(writing.statements, &[refined]).await?;
        let linked = writing.statements.add("UPDATE policies SET refined_by = ? WHERE id = ?");
        linked.bind(&refined.id).bind(&self.policy_id);
        Ok(())
    }
}

impl Verb for BeginRefinement {
    type Answer = Attempt;

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<Attempt, StoreError> {
        let Self(policy_id) = self;
        let begun =
            sqlx::query("UPDATE refinements SET attempts = attempts + 1 WHERE policy_id = $1 AND attempts < $2");
        let begun = begun.bind(policy_id).bind(MAX_ATTEMPTS).execute(writing.connection().await?).await?;
        if begun.rows_affected() > 0 {
            return Ok(Attempt::Begun);
        }
        let deleted = sqlx::query("DELETE FROM refinements WHERE policy_id = $1").bind(policy_id);
        let deleted = deleted.execute(writing.connection().await?).await?;
        Ok(if deleted.rows_affected() > 0 { Attempt::GivenUp } else { Attempt::Gone })
    }
}

impl Verb for ReturnRefinement {
    type Answer = ();

    async fn apply(&self, writing: &mut Writing<'_, '_>) -> Result<(), StoreError> {
        let returned = "UPDATE refinements SET attempts = attempts - 1 WHERE policy_id = $1 AND attempts > 0";
        sqlx::query(returned).bind(&self.0).execute(writing.connection().await?).await?;
        Ok(())
    }
}
