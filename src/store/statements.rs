//! Statements that are executed together: each execution costs the driver a change of threads, there and back, which takes milliseconds while the
//! processors have much to do.

use sqlx::encode::Encode;
use sqlx::query::Query;
use sqlx::sqlite::{SqliteArguments, SqliteRow};
use sqlx::{Arguments, AssertSqlSafe, Sqlite, SqliteConnection, Type};

use super::StoreError;

/// SQLite takes 32,766 values in a statement.
const MAX_ROWS: usize = 1000;

/// A connection, and statements that give nothing back, which wait to be executed together: when asked for, or before anything else is.
pub(super) struct Statements<'c> {
    connection: &'c mut SqliteConnection,
    sql: String,
    values: Values,
    /// Whether they come again like this, but for their values.
    are_usual: bool,
}

/// The values that statements are given, in the order of their `?`.
#[derive(Debug, Default)]
pub(super) struct Values(SqliteArguments);

impl Values {
    /// Adds one.
    pub(super) fn bind<'v>(&mut self, value: impl Encode<'v, Sqlite> + Type<Sqlite>) -> &mut Self {
        self.0.add(value).expect("texts, numbers and bytes are values");
        self
    }

    /// As what the driver takes.
    pub(super) fn into_arguments(self) -> SqliteArguments {
        self.0
    }
}

impl<'c> Statements<'c> {
    /// None yet.
    pub(super) fn on(connection: &'c mut SqliteConnection) -> Self {
        Self { connection, sql: String::new(), values: Values::default(), are_usual: true }
    }

    /// Adds a statement, which is given the values that are added then.
    pub(super) fn add(&mut self, statement: &str) -> &mut Values {
        if !self.sql.is_empty() {
            self.sql.push_str("; ");
        }
        self.sql.push_str(statement);
        &mut self.values
    }

    /// Inserts `rows`, whose columns `into` names and `bind` gives.
    pub(super) fn insert_rows<'r, R>(&mut self, into: &str, rows: &'r [R], bind: impl Fn(&mut Values, &'r R)) {
        for rows in rows.chunks(MAX_ROWS) {
            self.add(into);
            self.go_on_with_rows(rows, &bind);
        }
    }

    /// Goes on with `rows`, whose columns `bind` gives, in the statement that was added last.
    pub(super) fn go_on_with_rows<'r, R>(&mut self, rows: &'r [R], bind: impl Fn(&mut Values, &'r R)) {
        self.are_usual &= rows.len() <= 1;
        for (number, row) in rows.iter().enumerate() {
            let n_before = self.values.0.len();
            bind(&mut self.values, row);
            let columns = ["?"].repeat(self.values.0.len() - n_before).join(", ");
            self.sql.push_str(if number == 0 { "VALUES (" } else { ", (" });
            self.sql.push_str(&columns);
            self.sql.push(')');
        }
    }

    /// Goes on in the statement that was added last, which is given the values that are added then.
    pub(super) fn go_on(&mut self, sql: &str) -> &mut Values {
        self.sql.push_str(sql);
        &mut self.values
    }

    /// Executes what waits. Gives how many rows were changed.
    pub(super) async fn run(&mut self) -> Result<u64, StoreError> {
        let Some(query) = self.take() else { return Ok(0) };
        Ok(query.execute(&mut *self.connection).await?.rows_affected())
    }

    /// Undoes what was done in the transaction that has begun, and forgets what waits.
    pub(super) async fn undo(&mut self) -> Result<(), StoreError> {
        self.take();
        self.add("ROLLBACK");
        self.run().await.map(drop)
    }

    fn take(&mut self) -> Option<Query<'static, Sqlite, SqliteArguments>> {
        let (sql, values) = (std::mem::take(&mut self.sql), std::mem::take(&mut self.values));
        let are_usual = std::mem::replace(&mut self.are_usual, true);
        (!sql.is_empty()).then(|| sqlx::query_with(AssertSqlSafe(sql), values.into_arguments()).persistent(are_usual))
    }

    /// Executes what waits, and gives the connection.
    pub(super) async fn connection(&mut self) -> Result<&mut SqliteConnection, StoreError> {
        self.run().await?;
        Ok(self.connection)
    }

    /// Executes what waits, and then what gives a row or none. What it is given was added after it.
    pub(super) async fn fetch(&mut self) -> Result<Option<SqliteRow>, StoreError> {
        let Some(query) = self.take() else { return Ok(None) };
        Ok(query.fetch_optional(&mut *self.connection).await?)
    }

    /// The same of what gives any number of rows.
    pub(super) async fn fetch_all(&mut self) -> Result<Vec<SqliteRow>, StoreError> {
        let Some(query) = self.take() else { return Ok(Vec::new()) };
        Ok(query.fetch_all(&mut *self.connection).await?)
    }
}

#[cfg(test)]
mod tests {
    use sqlx::{Connection, Row};

    use super::*;

    #[tokio::test]
    async fn statements_that_wait_are_executed_in_order_each_with_its_values() {
        let mut connection = SqliteConnection::connect(":memory:").await.unwrap();
        let mut statements = Statements::on(&mut connection);
        assert_eq!(statements.run().await.unwrap(), 0, "there are none");
        statements.add("CREATE TABLE numbers (n INTEGER NOT NULL, name TEXT)");
        let rows: Vec<i64> = (1..=2 * i64::try_from(MAX_ROWS).unwrap() + 1).collect();
        statements.insert_rows("INSERT INTO numbers (n, name) ", &rows, |values, n| {
            values.bind(*n).bind((n % 2 == 0).then_some("even"));
        });
        statements.insert_rows("INSERT INTO numbers (n) ", &[] as &[i64], |values, n| {
            values.bind(*n);
        });
        statements.add("DELETE FROM numbers WHERE n = ? OR n = ?").bind(1).bind(3);
        statements.add("UPDATE numbers SET name = ? WHERE n < ? RETURNING n").bind("low").bind(6);
        let changed: Vec<i64> = statements.fetch_all().await.unwrap().iter().map(|row| row.get(0)).collect();
        assert_eq!(changed, [2, 4, 5]);
        for (name, n_expected) in [("low", 3), ("even", 998)] {
            statements.add("SELECT count(*) FROM numbers WHERE name = ?").bind(name);
            assert_eq!(statements.fetch().await.unwrap().unwrap().get::<i64, _>(0), n_expected, "{name}");
        }
        statements.add("SELECT n FROM numbers WHERE n = ?").bind(1);
        assert!(statements.fetch().await.unwrap().is_none());
        statements.add("DELETE FROM numbers WHERE n < ?").bind(6);
        assert_eq!(statements.run().await.unwrap(), 3);
    }

    #[tokio::test]
    async fn after_one_that_fails_none_is_executed() {
        let mut connection = SqliteConnection::connect(":memory:").await.unwrap();
        let mut statements = Statements::on(&mut connection);
        statements.add("CREATE TABLE numbers (n INTEGER NOT NULL UNIQUE)");
        statements.add("BEGIN");
        statements.insert_rows("INSERT INTO numbers (n) ", &[1, 1], |values, n| {
            values.bind(*n);
        });
        statements.add("INSERT INTO numbers (n) VALUES (?)").bind(2);
        statements.add("COMMIT");
        assert!(statements.run().await.is_err());
        statements.add("SELECT count(*) FROM numbers");
        assert_eq!(statements.fetch().await.unwrap().unwrap().get::<i64, _>(0), 0);
        statements.add("ROLLBACK");
        statements.run().await.unwrap();
    }
}
