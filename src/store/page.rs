//! Lists in parts.

use futures_util::{Stream, TryStreamExt};
use sqlx::Row;
use sqlx::sqlite::SqliteRow;

use super::StoreError;

/// A page ends with the item that brings the text of its rows to this size, in bytes. An answer takes a few times as much memory. Most
/// lists stay far below it, however many items are asked for.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// A part of a long list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Page<T> {
    /// The items, in order.
    pub items: Vec<T>,
    /// Names or ids of rows that belong here but hold what this program never writes.
    pub unreadable: Vec<String>,
    /// The key of the last row, if there are more.
    pub next: Option<String>,
}

/// What there is to know of the rows of a list.
pub(super) struct Rows<T> {
    pub(super) table: &'static str,
    /// By which column the list is ordered.
    pub(super) key: &'static str,
    /// Which column names a row.
    pub(super) name: &'static str,
    /// Which columns may be long.
    pub(super) long: &'static [&'static str],
    pub(super) read: fn(&SqliteRow) -> Result<T, StoreError>,
}

impl<T> Rows<T> {
    /// Makes a page of the first of `rows`: at least one if there is any, and at most `limit`. Either the query has asked for one row more
    /// than `limit`, or `rest` says whether there are more.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub(super) async fn page(
        &self,
        mut rows: impl Stream<Item = Result<SqliteRow, sqlx::Error>> + Unpin,
        limit: u32,
        rest: Rest,
    ) -> Result<Page<T>, StoreError> {
        let mut page = Page { items: Vec::new(), unreadable: Vec::new(), next: None };
        let (mut last, mut n_rows, mut n_bytes) = (None, 0, 0);
        while let Some(row) = rows.try_next().await? {
            if n_rows == limit || n_bytes >= MAX_BYTES {
                page.next = last;
                return Ok(page);
            }
            n_rows += 1;
            n_bytes += self.long.iter().map(|column| text(&row, column).map_or(0, <[u8]>::len)).sum::<usize>();
            last = shown(&row, self.key);
            match (self.read)(&row) {
                Ok(item) => page.items.push(item),
                Err(error) => {
                    let name = shown(&row, self.name).unwrap_or_default();
                    let error = error.of_row(self.table, &name);
                    if !error.is_of_a_row() {
                        return Err(error);
                    }
                    log_left_out(&error);
                    page.unreadable.push(name);
                }
            }
        }
        if rest == Rest::IsMore {
            page.next = last;
        }
        Ok(page)
    }
}

/// The statement that lists rows of `table` in the order of their sequence numbers, from the first after `$1`, at most `$2`. The columns
/// of the filter are to be `$3` and so on. Each has an index, whose entries with the same value are in the order of the list.
pub(super) fn listing(listed: &str, table: &str, filter: &[(&'static str, &str)]) -> String {
    let conditions = filter.iter().enumerate().map(|(n, (column, _))| format!(" AND {column} = ${}", n + 3));
    let conditions: String = conditions.collect();
    format!("SELECT {listed} FROM {table} WHERE sequence > $1{conditions} ORDER BY sequence LIMIT $2")
}

/// What comes after the rows of a query.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Rest {
    /// Nothing.
    IsNone,
    /// More of the list.
    IsMore,
}

/// How many of the next rows make a page of at most `limit`, and what comes after them, by the sizes of the rows in bytes. For rows that
/// may be too long to be read ahead.
pub(super) fn fitting(sizes: &[i64], limit: u32) -> (u32, Rest) {
    let (mut n_rows, mut n_bytes) = (0, 0_u64);
    for size in sizes {
        if n_rows == limit || n_bytes >= MAX_BYTES as u64 {
            return (n_rows, Rest::IsMore);
        }
        n_rows += 1;
        n_bytes = n_bytes.saturating_add(size.unsigned_abs());
    }
    (n_rows, Rest::IsNone)
}

impl<T> Page<T> {
    /// The page of what `item` makes of each item.
    pub fn map<U>(self, item: impl FnMut(T) -> U) -> Page<U> {
        let Self { items, unreadable, next } = self;
        Page { items: items.into_iter().map(item).collect(), unreadable, next }
    }

    /// The page of what `read` makes of each item. An item that cannot be read is left out, and its name is added to
    /// [`Self::unreadable`].
    pub fn map_readable<U, E: std::error::Error + 'static>(
        self,
        name: impl Fn(&T) -> &str,
        read: impl Fn(T) -> Result<U, E>,
    ) -> Page<U> {
        let Self { items, mut unreadable, next } = self;
        let mut readable = Vec::with_capacity(items.len());
        for item in items {
            let name = name(&item).to_owned();
            match read(item) {
                Ok(item) => readable.push(item),
                Err(error) => {
                    log_left_out(&error);
                    unreadable.push(name);
                }
            }
        }
        Page { items: readable, unreadable, next }
    }
}

fn log_left_out(error: &(dyn std::error::Error + 'static)) {
    tracing::error!(error, "a list leaves out a row");
}

fn text<'r>(row: &'r SqliteRow, column: &str) -> Option<&'r [u8]> {
    row.try_get::<Option<&[u8]>, _>(column).ok().flatten()
}

/// A name, an id or a number, as text, even of a row that is damaged.
fn shown(row: &SqliteRow, column: &str) -> Option<String> {
    let number = row.try_get::<i64, _>(column).ok().map(|number| number.to_string());
    number.or_else(|| text(row, column).map(|text| String::from_utf8_lossy(text).into_owned()))
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::store::{ModelSummary, NewDefinition, NewLearner, NewModel, NewPolicy, PolicyFilter, Replaces, Store};
    use etude_core::attribute::AttributeDocument;
    use etude_core::learning::Distribution;

    /// Half of what a page takes, so that it has two items.
    const HALF: usize = MAX_BYTES / 2;

    /// Reads all pages by `read`, and gives how many items each of them has.
    async fn n_items<T>(read: impl AsyncFn(Option<String>) -> Result<Page<T>, StoreError>) -> Vec<usize> {
        let (mut n_items, mut after) = (Vec::new(), None);
        loop {
            let page = read(after).await.unwrap();
            n_items.push(page.items.len());
            match page.next {
                Some(next) => after = Some(next),
                None => return n_items,
            }
        }
    }

    #[tokio::test]
    async fn pages_of_long_rows_end_early_and_the_next_one_goes_on() {
        const N: usize = 5;
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
        let now = Timestamp::UNIX_EPOCH;
        let long = "a".repeat(HALF);
        let attribute: AttributeDocument =
            serde_json::from_value(serde_json::json!({"name": "x", "kind": "cyclic", "labels": [long]})).unwrap();
        for n in 0..N {
            let policy = NewPolicy::plain(&n.to_string(), &format!("\"{long}\""), now);
            store.add_policies(vec![policy], Vec::new()).await.unwrap();
            let summary = ModelSummary {
                name: n.to_string(),
                hash: String::new(),
                definition_hash: None,
                attributes: vec![attribute.clone()],
                actions: Vec::new(),
                size: None,
                n_stochastic: 0,
                n_unsafe: 0,
                created_at: now,
            };
            store
                .register_model(NewModel {
                    summary,
                    definition: NewDefinition::Text(String::new()),
                    replaces: Replaces::Nothing,
                })
                .await
                .unwrap();
            let learner = NewLearner {
                name: n.to_string(),
                hash: String::new(),
                definition: long.clone(),
                initial: Distribution { mean: Vec::new(), sd: Vec::new(), expected_reward: None },
                created_at: now,
            };
            store.register_learner(learner).await.unwrap();
        }
        let number = |after: Option<String>| after.map_or(0, |after| after.parse().unwrap());
        assert_eq!(
            n_items(async |after| store.policies(&PolicyFilter::default(), number(after), 1000).await).await,
            [2, 2, 1]
        );
        assert_eq!(n_items(async |after| store.models(after.as_deref(), 1000).await).await, [2, 2, 1]);
        assert_eq!(n_items(async |after| store.learners(after.as_deref(), 1000).await).await, [2, 2, 1]);
        // Fewer may be asked for, or be longer than a page.
        assert_eq!(n_items(async |after| store.models(after.as_deref(), 1).await).await, [1; N]);
        assert_eq!(fitting(&[i64::MAX, 1], 10), (1, Rest::IsMore));
        assert_eq!(
            (fitting(&[], 10), fitting(&[1, 1], 2), fitting(&[1, 1, 1], 2)),
            ((0, Rest::IsNone), (2, Rest::IsNone), (2, Rest::IsMore))
        );
    }

    #[tokio::test]
    async fn whatever_a_list_is_filtered_by_has_an_index_in_the_order_of_the_list() {
        let directory = tempfile::tempdir().unwrap();
        let store = Store::open(&directory.path().join("etude.db"), &TaskTracker::new()).await.unwrap();
        for (table, columns) in [("policies", &["model", "learner", "status"][..]), ("sessions", &["model", "status"])]
        {
            // Every choice of them but none.
            for chosen in 1..1_u32 << columns.len() {
                let filter = columns.iter().enumerate().filter(|(n, _)| chosen & 1 << n != 0);
                let filter: Vec<_> = filter.map(|(_, column)| (*column, "")).collect();
                let explain = format!("EXPLAIN QUERY PLAN {}", listing("*", table, &filter));
                let mut query = sqlx::query(sqlx::AssertSqlSafe(explain)).bind(0).bind(100);
                for (_, value) in &filter {
                    query = query.bind(*value);
                }
                let plan = query.fetch_all(&mut *store.reader().await.unwrap()).await.unwrap();
                let plan: Vec<String> = plan.iter().map(|row| row.get("detail")).collect();
                let is_indexed = |(column, _): &(&str, &str)| {
                    plan[0]
                        .starts_with(&format!("SEARCH {table} USING INDEX {table}_by_{column} ({column}=? AND rowid>?"))
                };
                assert!(plan.len() == 1 && filter.iter().any(is_indexed), "{filter:?}: {plan:?}");
            }
        }
    }
}
