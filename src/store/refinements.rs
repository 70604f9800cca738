//! The table of policies that wait to be refined.

use sqlx::{Row, SqliteConnection};

use super::policies::{self, NewPolicy};
use super::writer::Write;
use super::{Store, StoreError};

/// A policy that is to be refined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewRefinement {
    /// The policy.
    pub policy_id: String,
    /// Hash of its model's content.
    pub model_hash: String,
    /// JSON: the request for the refined policy.
    pub request: String,
}

/// The end of a refinement.
#[derive(Clone, Debug)]
pub struct RefinementEnd {
    /// The policy that was to be refined.
    pub policy_id: String,
    /// The refined policy; `None` if there can be none any more.
    pub refined: Option<NewPolicy>,
}

impl Store {
    /// The refinement that has waited longest of those after the sequence number `after`, with its own.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn next_refinement(&self, after: i64) -> Result<Option<(i64, NewRefinement)>, StoreError> {
        let query = sqlx::query(
            "SELECT rowid AS sequence, policy_id, model_hash, request FROM refinements WHERE rowid > $1
             ORDER BY rowid LIMIT 1",
        );
        let Some(row) = query.bind(after).fetch_optional(&self.readers).await? else { return Ok(None) };
        let refinement = NewRefinement {
            policy_id: row.try_get("policy_id")?,
            model_hash: row.try_get("model_hash")?,
            request: row.try_get("request")?,
        };
        Ok(Some((row.try_get("sequence")?, refinement)))
    }

    /// Stores a refined policy and links the two.
    ///
    /// # Errors
    ///
    /// If the database failed; then nothing was stored.
    pub async fn end_refinement(&self, end: RefinementEnd) -> Result<(), StoreError> {
        self.writer.write(Write::EndRefinement(Box::new(end))).await.map(drop)
    }
}

pub(super) async fn add(connection: &mut SqliteConnection, refinement: &NewRefinement) -> Result<(), StoreError> {
    sqlx::query("INSERT INTO refinements (policy_id, model_hash, request) VALUES ($1, $2, $3)")
        .bind(&refinement.policy_id)
        .bind(&refinement.model_hash)
        .bind(&refinement.request)
        .execute(connection)
        .await?;
    Ok(())
}

pub(super) async fn end(connection: &mut SqliteConnection, end: &RefinementEnd) -> Result<(), StoreError> {
    let deleted = sqlx::query("DELETE FROM refinements WHERE policy_id = $1").bind(&end.policy_id);
    let was_waiting = deleted.execute(&mut *connection).await?.rows_affected() > 0;
    let (true, Some(refined)) = (was_waiting, &end.refined) else { return Ok(()) };
    policies::add(connection, refined).await?;
    sqlx::query(
        "UPDATE policies SET summary = json_set(summary, '$.refined_by', $2),
             policy = iif(steps IS NULL, json_set(policy, '$.refined_by', $2), policy)
         WHERE id = $1",
    )
    .bind(&end.policy_id)
    .bind(&refined.id)
    .execute(connection)
    .await?;
    Ok(())
}
