//! How policies come to their table: many in one statement.

use std::sync::OnceLock;

use sqlx::{AssertSqlSafe, SqlSafeStr, SqlStr, SqliteConnection};

use super::{NewPolicy, PolicyClass, checksum};
use crate::store::StoreError;
use crate::store::statements::{Statements, Values};

const INTO: &str = "INSERT INTO policies (id, model, learner, status, summary, steps, checksum, created_at_ms) ";

/// Most policies that one statement inserts. For each number of policies there is a statement, which is prepared once and kept.
const MAX_ROWS: usize = 64;

/// Most bytes of the policies of one statement, unless one policy alone has more: the driver copies them.
const MAX_ROWS_BYTES: usize = 1 << 20;

/// Adds policies in this order, within a transaction.
pub(in crate::store) async fn add_all(
    statements: &mut Statements<'_>,
    policies: &[&NewPolicy],
) -> Result<(), StoreError> {
    let mut rest = policies;
    while !rest.is_empty() {
        let (rows, after) = rest.split_at(n_fitting(rest));
        statements.insert_rows(INTO, rows, |values, policy| bind(values, policy));
        rest = after;
        if !rest.is_empty() {
            statements.run().await?;
        }
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
pub(in crate::store) async fn add_at_once(
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
    let mut values = Values::default();
    for policy in policies {
        bind(&mut values, policy);
    }
    sqlx::query_with(insert_of(policies.len()), values.into_arguments()).execute(connection).await?;
    Ok(())
}

fn bind(values: &mut Values, policy: &NewPolicy) {
    let checksum = checksum(&policy.summary, &policy.steps);
    let PolicyClass { model, learner, status } = &policy.class;
    values.bind(&policy.id).bind(model).bind(learner).bind(status.name());
    values.bind(&policy.summary).bind(&policy.steps).bind(checksum).bind(policy.created_at.as_millisecond());
}

/// The statement that inserts so many policies, which is put together once.
fn insert_of(n_rows: usize) -> SqlStr {
    static INSERTS: [OnceLock<SqlStr>; MAX_ROWS + 1] = [const { OnceLock::new() }; MAX_ROWS + 1];
    let put_together = || {
        let rows = vec!["(?, ?, ?, ?, ?, ?, ?, ?)"; n_rows].join(", ");
        AssertSqlSafe(format!("{INTO}VALUES {rows}")).into_sql_str()
    };
    match INSERTS.get(n_rows) {
        Some(insert) => insert.get_or_init(put_together).clone(),
        None => put_together(),
    }
}
