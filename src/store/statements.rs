//! Many rows in a statement: each statement costs the driver a change of threads.

use sqlx::query_builder::{QueryBuilder, Separated};
use sqlx::{Sqlite, SqliteConnection};

use super::StoreError;

/// Inserts `rows`, whose columns `into` names and `bind` gives, by as few statements as SQLite takes.
pub(super) async fn insert_rows<'r, R>(
    connection: &mut SqliteConnection,
    into: &str,
    rows: &'r [R],
    bind: impl Fn(Separated<'_, Sqlite, &'static str>, &'r R),
) -> Result<(), StoreError> {
    /// SQLite takes 32,766 values in a statement.
    const MAX_ROWS: usize = 1000;
    for rows in rows.chunks(MAX_ROWS) {
        let mut query = QueryBuilder::new(into);
        query.push_values(rows, &bind);
        // Of several rows, hardly two are alike.
        query.build().persistent(rows.len() == 1).execute(&mut *connection).await?;
    }
    Ok(())
}
