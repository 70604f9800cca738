//! The table of policies.

use std::sync::OnceLock;

use jiff::Timestamp;
use sqlx::{AssertSqlSafe, Row, SqlSafeStr, SqlStr, SqliteConnection};

use super::refinements::NewRefinement;
use super::writer::Write;
use super::{Page, Store, StoreError, corrupt};
use crate::mapping::read_answer;

/// A policy to be stored.
#[derive(Clone, Debug)]
pub struct NewPolicy {
    /// Its id, unique.
    pub id: String,
    /// JSON: the policy without its steps.
    pub summary: String,
    /// Its steps in short, as [`WrittenPolicy`](crate::mapping::WrittenPolicy) has them.
    pub steps: Vec<u8>,
    /// When it was made.
    pub created_at: Timestamp,
}

/// A policy without its steps, as it is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicySummaryRow {
    /// The order in which it became durable.
    pub sequence: i64,
    /// JSON.
    pub summary: String,
}

impl Store {
    /// Stores policies in this order, all of them or none, and notes which of them are to be refined.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn add_policies(
        &self,
        policies: Vec<NewPolicy>,
        refinements: Vec<NewRefinement>,
    ) -> Result<(), StoreError> {
        self.writer.write(Write::AddPolicies(policies, refinements)).await.map(drop)
    }

    /// The policy with this id, as it was answered: JSON.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn policy(&self, id: &str) -> Result<Option<String>, StoreError> {
        let query = sqlx::query("SELECT summary, policy, steps FROM policies WHERE id = $1").bind(id);
        let Some(row) = query.fetch_optional(&self.readers).await? else { return Ok(None) };
        let Some(steps) = row.try_get::<Option<Vec<u8>>, _>("steps")? else { return Ok(Some(row.try_get("policy")?)) };
        let summary: String = row.try_get("summary")?;
        let answer = if steps.len() <= MAX_INLINE_BYTES {
            read_answer(&summary, &steps)
        } else {
            let reading = self.tasks.spawn_blocking(move || read_answer(&summary, &steps));
            reading.await.map_err(corrupt("policies", "steps"))?
        };
        Ok(Some(answer.map_err(corrupt("policies", "steps"))?))
    }

    /// At most `limit` policies in the order in which they became durable, from the first after the sequence number
    /// `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn policies(&self, after: i64, limit: u32) -> Result<Page<PolicySummaryRow>, StoreError> {
        let query =
            sqlx::query("SELECT sequence, summary FROM policies WHERE sequence > $1 ORDER BY sequence LIMIT $2");
        let rows = query.bind(after).bind(i64::from(limit) + 1).fetch_all(&self.readers).await?;
        let read = |row: &sqlx::sqlite::SqliteRow| -> Result<PolicySummaryRow, StoreError> {
            let sequence = row.try_get("sequence").map_err(corrupt("policies", "sequence"))?;
            Ok(PolicySummaryRow { sequence, summary: row.try_get("summary")? })
        };
        let policies = rows.iter().map(read).collect::<Result<Vec<_>, _>>()?;
        Ok(Page::of(policies, limit, |policy| policy.sequence.to_string()))
    }
}

pub(super) async fn add(connection: &mut SqliteConnection, policy: &NewPolicy) -> Result<(), StoreError> {
    add_all(connection, &[policy]).await
}

/// Policies whose steps in short are up to this size are written where they are asked for, which takes a millisecond or so; larger
/// ones on a thread of their own.
const MAX_INLINE_BYTES: usize = 32 * 1024;

/// Most policies that a statement inserts. Each number of them is a statement of its own, which is prepared once and kept.
const MAX_ROWS: usize = 64;

/// Adds policies in this order, within a transaction.
pub(super) async fn add_all(connection: &mut SqliteConnection, policies: &[&NewPolicy]) -> Result<(), StoreError> {
    for rows in policies.chunks(MAX_ROWS) {
        insert(connection, rows).await?;
    }
    Ok(())
}

/// Adds policies in this order, all of them or none, outside of a transaction: one statement, which is durable when this returns.
/// Says whether they were added; they are not if they are none, or too many.
pub(super) async fn add_at_once(
    connection: &mut SqliteConnection,
    policies: &[&NewPolicy],
) -> Result<bool, StoreError> {
    let fits = (1..=MAX_ROWS).contains(&policies.len());
    if fits {
        insert(connection, policies).await?;
    }
    Ok(fits)
}

/// Adds some policies. Each statement costs the driver a change of threads, so there is only one.
async fn insert(connection: &mut SqliteConnection, policies: &[&NewPolicy]) -> Result<(), StoreError> {
    let mut insert = sqlx::query(insert_of(policies.len()));
    for policy in policies {
        insert =
            insert.bind(&policy.id).bind(&policy.summary).bind(&policy.steps).bind(policy.created_at.as_millisecond());
    }
    insert.execute(connection).await?;
    Ok(())
}

/// The statement that inserts so many policies, which is put together once.
fn insert_of(n_rows: usize) -> SqlStr {
    static INSERTS: [OnceLock<SqlStr>; MAX_ROWS + 1] = [const { OnceLock::new() }; MAX_ROWS + 1];
    let put_together = || {
        let rows = vec!["(?, ?, '', ?, ?)"; n_rows].join(", ");
        let insert = format!("INSERT INTO policies (id, summary, policy, steps, created_at_ms) VALUES {rows}");
        AssertSqlSafe(insert).into_sql_str()
    };
    match INSERTS.get(n_rows) {
        Some(insert) => insert.get_or_init(put_together).clone(),
        None => put_together(),
    }
}
