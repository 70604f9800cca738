//! The table of policies.
//!
//! What is stored of a policy is never changed, and has a checksum. The link to the one that refines it is a column of its own, and
//! becomes part of the text when that is read.

use std::sync::OnceLock;

use jiff::Timestamp;
use sqlx::sqlite::SqliteRow;
use sqlx::{AssertSqlSafe, Row, SqlSafeStr, SqlStr, SqliteConnection};

use super::page::{Rest, Rows};
use super::refinements::NewRefinement;
use super::writer::Write;
use super::{Page, Store, StoreError};
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

impl NewPolicy {
    /// How much there is to be written.
    pub(super) fn n_bytes(&self) -> usize {
        self.summary.len() + self.steps.len()
    }
}

/// A policy without its steps, as it is stored.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PolicySummaryRow {
    /// The order in which it became durable.
    pub sequence: i64,
    /// Its id.
    pub id: String,
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
        let query =
            sqlx::query("SELECT summary, policy, steps, checksum, refined_by FROM policies WHERE id = $1").bind(id);
        let Some(row) = query.fetch_optional(&mut *self.reader().await?).await? else { return Ok(None) };
        match self.read_policy(&row).await {
            Ok(policy) => Ok(Some(policy)),
            Err(error) => Err(error.of_row("policies", id)),
        }
    }

    async fn read_policy(&self, row: &SqliteRow) -> Result<String, StoreError> {
        let steps: Option<Vec<u8>> = row.try_get("steps")?;
        let summary: String = row.try_get("summary")?;
        let stored = stored_checksum(row)?;
        let Some(steps) = steps else {
            let policy: String = row.try_get("policy")?;
            return linked(policy, row);
        };
        if stored.is_some_and(|stored| stored != checksum(&summary, &steps)) {
            return Err(corrupt("checksum")("it is not that of the summary and the steps"));
        }
        let answer = if steps.len() <= MAX_INLINE_BYTES {
            read_answer(&summary, &steps)
        } else {
            let reading = self.tasks.spawn_blocking(move || read_answer(&summary, &steps));
            reading.await.map_err(corrupt("steps"))?
        };
        linked(answer.map_err(corrupt("steps"))?, row)
    }

    /// At most `limit` policies in the order in which they became durable, from the first after the sequence number
    /// `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn policies(&self, after: i64, limit: u32) -> Result<Page<PolicySummaryRow>, StoreError> {
        let query = sqlx::query(
            "SELECT sequence, id, summary, checksum, refined_by FROM policies WHERE sequence > $1 ORDER BY sequence LIMIT $2",
        );
        let mut reader = self.reader().await?;
        let rows = query.bind(after).bind(i64::from(limit) + 1).fetch(&mut *reader);
        Rows { table: TABLE, key: "sequence", name: "id", long: &["summary"], read: read_summary }
            .page(rows, limit, Rest::IsNone)
            .await
    }
}

const TABLE: &str = "policies";

fn corrupt<E: Into<Box<dyn std::error::Error + Send + Sync>>>(column: &'static str) -> impl FnOnce(E) -> StoreError {
    super::corrupt(TABLE, column)
}

/// What tells whether a policy is as it was written: CRC-32, of the summary in the upper half and of the steps in the lower one.
fn checksum(summary: &str, steps: &[u8]) -> i64 {
    half_checksum(summary) | i64::from(crc32fast::hash(steps))
}

/// The same, of the summary alone.
fn half_checksum(summary: &str) -> i64 {
    i64::from(crc32fast::hash(summary.as_bytes())) << 32
}

/// The one that is stored; `None` of a policy that was stored before there were any.
fn stored_checksum(row: &SqliteRow) -> Result<Option<i64>, StoreError> {
    Ok(row.try_get("checksum")?)
}

fn read_summary(row: &SqliteRow) -> Result<PolicySummaryRow, StoreError> {
    let summary: String = row.try_get("summary")?;
    if stored_checksum(row)?.is_some_and(|stored| (stored >> 32) << 32 != half_checksum(&summary)) {
        return Err(corrupt("checksum")("it is not that of the summary"));
    }
    Ok(PolicySummaryRow { sequence: row.try_get("sequence")?, id: row.try_get("id")?, summary: linked(summary, row)? })
}

/// The text of a policy or its summary, with the link to the policy that refines it, if there is one.
fn linked(text: String, row: &SqliteRow) -> Result<String, StoreError> {
    /// How all of them end that were not refined yet when they were written.
    const NOT_REFINED: &str = r#""refined_by":null}"#;
    let refined_by: Option<&str> = row.try_get("refined_by")?;
    let Some(refined_by) = refined_by else { return Ok(text) };
    let Some(before) = text.strip_suffix(NOT_REFINED) else {
        return Err(corrupt("refined_by")("the policy names another one, or none"));
    };
    let refined_by = serde_json::to_string(refined_by).map_err(corrupt("refined_by"))?;
    Ok(format!(r#"{before}"refined_by":{refined_by}}}"#))
}

pub(super) async fn add(connection: &mut SqliteConnection, policy: &NewPolicy) -> Result<(), StoreError> {
    add_all(connection, &[policy]).await
}

/// Policies whose steps in short are up to this size are written where they are asked for, which takes a millisecond or so; larger
/// ones on a thread of their own.
const MAX_INLINE_BYTES: usize = 32 * 1024;

/// Most policies that a statement inserts. Each number of them is a statement of its own, which is prepared once and kept.
const MAX_ROWS: usize = 64;

/// Most bytes of them, which the driver has a copy of meanwhile, unless one alone has more.
const MAX_ROWS_BYTES: usize = 1 << 20;

/// Adds policies in this order, within a transaction.
pub(super) async fn add_all(connection: &mut SqliteConnection, policies: &[&NewPolicy]) -> Result<(), StoreError> {
    let mut rest = policies;
    while !rest.is_empty() {
        let (rows, after) = rest.split_at(n_fitting(rest));
        insert(connection, rows).await?;
        rest = after;
    }
    Ok(())
}

/// How many of these, of which there are some, a statement inserts.
fn n_fitting(policies: &[&NewPolicy]) -> usize {
    let mut n_bytes = 0;
    let fits = |policy: &&&NewPolicy| {
        n_bytes += policy.n_bytes();
        n_bytes <= MAX_ROWS_BYTES
    };
    policies.iter().take(MAX_ROWS).take_while(fits).count().max(1)
}

/// Adds policies in this order, all of them or none, outside of a transaction: one statement, which is durable when this returns.
/// Says whether they were added; they are not if they are none, or too much.
pub(super) async fn add_at_once(
    connection: &mut SqliteConnection,
    policies: &[&NewPolicy],
) -> Result<bool, StoreError> {
    let fits = !policies.is_empty() && n_fitting(policies) == policies.len();
    if fits {
        insert(connection, policies).await?;
    }
    Ok(fits)
}

/// Adds some policies. Each statement costs the driver a change of threads, so there is only one.
async fn insert(connection: &mut SqliteConnection, policies: &[&NewPolicy]) -> Result<(), StoreError> {
    let mut insert = sqlx::query(insert_of(policies.len()));
    for policy in policies {
        let checksum = checksum(&policy.summary, &policy.steps);
        insert = insert.bind(&policy.id).bind(&policy.summary).bind(&policy.steps).bind(checksum);
        insert = insert.bind(policy.created_at.as_millisecond());
    }
    insert.execute(connection).await?;
    Ok(())
}

/// The statement that inserts so many policies, which is put together once.
fn insert_of(n_rows: usize) -> SqlStr {
    static INSERTS: [OnceLock<SqlStr>; MAX_ROWS + 1] = [const { OnceLock::new() }; MAX_ROWS + 1];
    let put_together = || {
        let rows = vec!["(?, ?, '', ?, ?, ?)"; n_rows].join(", ");
        let insert =
            format!("INSERT INTO policies (id, summary, policy, steps, checksum, created_at_ms) VALUES {rows}");
        AssertSqlSafe(insert).into_sql_str()
    };
    match INSERTS.get(n_rows) {
        Some(insert) => insert.get_or_init(put_together).clone(),
        None => put_together(),
    }
}
