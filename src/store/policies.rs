//! The table of policies.
//!
//! The text and the steps of a policy have a checksum, and are never changed, but that the text forgets a policy that it refines and that is
//! deleted. The id of the policy that refines it is a column of its own, and is put into the text when that is read.

mod insertion;

use jiff::Timestamp;
use serde_json::value::RawValue;
use sqlx::sqlite::SqliteRow;
use sqlx::{AssertSqlSafe, Row, SqliteConnection};

use super::page::{self, Rest, Rows};
use super::{Page, Store, StoreError, as_integer};
use crate::memory::{Held, Memory};
use etude_core::mapping::{ShortSteps, Status, WrittenPolicy};
pub(super) use insertion::{add_all, add_at_once};

/// A policy to be stored.
#[derive(Clone, Debug)]
pub struct NewPolicy {
    /// Its id, unique.
    pub id: String,
    /// What lists are filtered by.
    pub class: PolicyClass,
    /// JSON: the policy without its steps.
    pub summary: String,
    /// Its steps in short, packed by [`pack_steps`].
    pub steps: Vec<u8>,
    /// When it was made.
    pub created_at: Timestamp,
}

/// What lists of policies are filtered by, as the summary has it.
#[derive(Clone, Debug)]
pub struct PolicyClass {
    /// Name of its model.
    pub model: String,
    /// The learner whose weights were used, if any.
    pub learner: Option<String>,
    /// What was proven of it.
    pub status: Status,
}

/// Which policies are listed: those that have all that is given.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PolicyFilter {
    /// Name of their model.
    pub model: Option<String>,
    /// The learner whose weights were used.
    pub learner: Option<String>,
    /// What was proven of them.
    pub status: Option<Status>,
}

impl PolicyFilter {
    /// The columns that are to have a value.
    fn columns(&self) -> Vec<(&'static str, &str)> {
        let Self { model, learner, status } = self;
        let columns =
            [("model", model.as_deref()), ("learner", learner.as_deref()), ("status", status.map(Status::name))];
        columns.into_iter().filter_map(|(column, value)| Some((column, value?))).collect()
    }
}

impl NewPolicy {
    /// How many bytes there are to be written.
    pub(super) fn n_bytes(&self) -> usize {
        self.summary.len() + self.steps.len()
    }
}

/// A policy that is to be refined.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewRefinement {
    /// The policy.
    pub policy_id: String,
    /// Hash of its model's content.
    pub model_hash: String,
    /// The session whose observations are the demonstration; `None` if the request has that.
    pub session_id: Option<String>,
    /// JSON: the request for the refined policy.
    pub request: String,
}

impl NewRefinement {
    /// How many bytes there are to be written.
    pub(super) fn n_bytes(&self) -> usize {
        self.request.len()
    }
}

/// Adds policies, all of them or none, and notes those that are to be refined.
#[derive(Debug)]
pub(super) struct AddPolicies {
    pub(super) policies: Vec<NewPolicy>,
    pub(super) refinements: Vec<NewRefinement>,
}

impl AddPolicies {
    /// How many bytes there are to be written.
    pub(super) fn n_bytes(&self) -> usize {
        let policies = self.policies.iter().map(NewPolicy::n_bytes);
        policies.chain(self.refinements.iter().map(NewRefinement::n_bytes)).sum()
    }
}

/// A policy without its steps, as it is stored.
#[derive(Clone, Debug)]
pub struct PolicyRecord {
    /// The order in which it became durable.
    pub sequence: i64,
    /// Its id.
    pub id: String,
    /// JSON: the policy without its steps.
    pub summary: Box<RawValue>,
}

/// Which links the text of a policy has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Links {
    /// Those that there are.
    Now,
    /// Those that it was answered with when it was made: none to a policy that refines it.
    AsMade,
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
        self.writer.add_policies(AddPolicies { policies, refinements }).await
    }

    /// The policy with this id, as it was answered: JSON.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn policy(&self, id: &str) -> Result<Option<String>, StoreError> {
        /// Far more than any.
        const ANY: u64 = 1 << 40;
        Ok(self.policy_within(id, Links::Now, &Memory::with_room(ANY)).await?.map(|(policy, _)| policy))
    }

    /// The policy with this id, as it was answered (JSON), and what it takes of `memory`, if it is much: taken before it is read.
    ///
    /// # Errors
    ///
    /// [`StoreError::NoRoom`] if there is not so much, or if the database failed.
    pub async fn policy_within(
        &self,
        id: &str,
        links: Links,
        memory: &Memory,
    ) -> Result<Option<(String, Option<Held>)>, StoreError> {
        /// The stored bytes, and the text that is written from them: unpacked steps take up to four times as many bytes as packed ones.
        const COPIES: usize = 6;
        let read = async {
            let Some(row) = self.policy_row(id, MAX_INLINE_BYTES).await? else { return Ok(None) };
            let n_bytes = n_bytes_of(&row)?;
            let mut held = None;
            if n_bytes <= MAX_INLINE_BYTES {
                return self.read_policy(&row, links, held, memory).await.map(Some);
            }
            memory.reserve(&mut held, COPIES * n_bytes)?;
            drop(row);
            // It has no more bytes, whichever links have changed between the two reads.
            let Some(row) = self.policy_row(id, n_bytes).await? else { return Ok(None) };
            self.read_policy(&row, links, held, memory).await.map(Some)
        };
        read.await.map_err(|error: StoreError| error.of_row("policies", id))
    }

    /// How many bytes are stored of a policy, and what that is, if it is no more than `max_bytes`.
    async fn policy_row(&self, id: &str, max_bytes: usize) -> Result<Option<SqliteRow>, StoreError> {
        let query = sqlx::query(
            "SELECT n_bytes, checksum, refined_by, IIF(n_bytes <= $2, summary, '') AS summary,
                 IIF(n_bytes <= $2, steps, x'') AS steps
             FROM (SELECT *, octet_length(summary) + octet_length(steps) AS n_bytes FROM policies WHERE id = $1)",
        );
        let query = query.bind(id).bind(as_integer(max_bytes as u64));
        Ok(query.fetch_optional(&mut *self.reader().await?).await?)
    }

    async fn read_policy(
        &self,
        row: &SqliteRow,
        links: Links,
        held: Option<Held>,
        memory: &Memory,
    ) -> Result<(String, Option<Held>), StoreError> {
        let link = |answer| if links == Links::Now { linked(answer, row) } else { Ok(answer) };
        let steps: Vec<u8> = row.try_get("steps")?;
        let summary: String = row.try_get("summary")?;
        if row.try_get::<i64, _>("checksum")? != checksum(&summary, &steps) {
            return Err(corrupt("checksum")("it is not that of the summary and the steps"));
        }
        if summary.len() + steps.len() <= MAX_INLINE_BYTES
            && let Some((answer, held)) = write_answer(&summary, &steps, MAX_INLINE_ANSWER_BYTES, memory)?
        {
            return Ok((link(answer)?, held));
        }
        let memory = memory.clone();
        let writing = self.tasks.spawn_blocking(move || {
            let _held = held;
            write_answer(&summary, &steps, usize::MAX, &memory)
        });
        let written = writing.await.map_err(corrupt("steps"))??;
        let (answer, held) = written.ok_or_else(|| corrupt("steps")("they are too many"))?;
        Ok((link(answer)?, held))
    }

    /// At most `limit` of the policies that are wanted, in the order in which they became durable, from the first after the sequence number
    /// `after`.
    ///
    /// # Errors
    ///
    /// If the database failed.
    pub async fn policies(
        &self,
        filter: &PolicyFilter,
        after: i64,
        limit: u32,
    ) -> Result<Page<PolicyRecord>, StoreError> {
        let columns = filter.columns();
        let mut query = sqlx::query(AssertSqlSafe(page::listing(LISTED, TABLE, &columns)));
        query = query.bind(after).bind(i64::from(limit) + 1);
        for (_, value) in &columns {
            query = query.bind(*value);
        }
        let mut reader = self.reader().await?;
        let rows = query.fetch(&mut *reader);
        Rows { table: TABLE, key: "sequence", name: "id", long: &["summary"], read: read_summary }
            .page(rows, limit, Rest::IsNone)
            .await
    }
}

const TABLE: &str = "policies";

/// What a list has of each.
const LISTED: &str = "sequence, id, summary, checksum, refined_by";

fn corrupt<E: Into<Box<dyn std::error::Error + Send + Sync>>>(column: &'static str) -> impl FnOnce(E) -> StoreError {
    super::corrupt(TABLE, column)
}

/// The checksum of a policy: CRC-32 of the summary in the upper half, of the steps in the lower half.
fn checksum(summary: &str, steps: &[u8]) -> i64 {
    half_checksum(summary) | i64::from(crc32fast::hash(steps))
}

/// The upper half of the checksum, which is that of the summary.
fn half_checksum(summary: &str) -> i64 {
    i64::from(crc32fast::hash(summary.as_bytes())) << 32
}

fn read_summary(row: &SqliteRow) -> Result<PolicyRecord, StoreError> {
    let summary: String = row.try_get("summary")?;
    if (row.try_get::<i64, _>("checksum")? >> 32) << 32 != half_checksum(&summary) {
        return Err(corrupt("checksum")("it is not that of the summary"));
    }
    let summary = RawValue::from_string(linked(summary, row)?).map_err(corrupt("summary"))?;
    Ok(PolicyRecord { sequence: row.try_get("sequence")?, id: row.try_get("id")?, summary })
}

/// Steps as they are stored: postcard.
///
/// # Errors
///
/// Never: all of them can be packed.
pub fn pack_steps(steps: &ShortSteps<'_>) -> Result<Vec<u8>, StoreError> {
    postcard::to_extend(steps, Vec::with_capacity(steps.n_bytes())).map_err(corrupt("steps"))
}

/// Writes a policy as it was answered, and takes what that needs of `memory`. Nothing if that may be more than `max_bytes`.
fn write_answer(
    summary: &str,
    steps: &[u8],
    max_bytes: usize,
    memory: &Memory,
) -> Result<Option<(String, Option<Held>)>, StoreError> {
    let steps = postcard::from_bytes(steps).map_err(corrupt("steps"))?;
    let stored = WrittenPolicy::read(summary, steps).map_err(corrupt("steps"))?;
    let n_bytes = stored.answer_bytes().map_err(corrupt("steps"))?;
    if n_bytes > max_bytes {
        return Ok(None);
    }
    let mut held = None;
    memory.reserve(&mut held, n_bytes)?;
    let answer = stored.answer(Some(n_bytes)).map_err(corrupt("steps"))?;
    debug_assert!(answer.len() + MAX_LINK_BYTES <= n_bytes, "{} of {n_bytes}", answer.len());
    Ok(Some((answer, held)))
}

/// How many bytes are stored of a policy.
fn n_bytes_of(row: &SqliteRow) -> Result<usize, StoreError> {
    let n_bytes: i64 = row.try_get("n_bytes")?;
    usize::try_from(n_bytes).map_err(corrupt("steps"))
}

/// Most bytes that a link adds to the text.
const MAX_LINK_BYTES: usize = 64;

/// The text of a policy or its summary, with the link to the policy that refines it, if there is one.
fn linked(mut text: String, row: &SqliteRow) -> Result<String, StoreError> {
    /// The end of every text, as no policy was refined yet when it was written.
    const NOT_REFINED: &str = r#""refined_by":null}"#;
    let refined_by: Option<&str> = row.try_get("refined_by")?;
    let Some(refined_by) = refined_by else { return Ok(text) };
    let Some(before) = text.strip_suffix(NOT_REFINED) else {
        return Err(corrupt("refined_by")("the policy names another one, or none"));
    };
    let refined_by = serde_json::to_string(refined_by).map_err(corrupt("refined_by"))?;
    text.truncate(before.len());
    text.extend([r#""refined_by":"#, &refined_by, "}"]);
    Ok(text)
}

/// Takes the link to the policy `refined`, which is deleted, out of the text of the one with this id, unless that is damaged.
pub(super) async fn forget_refined(
    connection: &mut SqliteConnection,
    id: &str,
    refined: &str,
) -> Result<(), StoreError> {
    let end = |refines: Option<&str>| {
        let refines = serde_json::to_string(&refines).map_err(corrupt("summary"))?;
        Ok::<_, StoreError>(format!(r#""refines":{refines},"refined_by":null}}"#))
    };
    let query = sqlx::query_as::<_, (String, i64)>("SELECT summary, checksum FROM policies WHERE id = $1").bind(id);
    let Some((mut summary, checksum)) = query.fetch_optional(&mut *connection).await? else { return Ok(()) };
    let of_steps = checksum & i64::from(u32::MAX);
    if checksum != half_checksum(&summary) | of_steps {
        return Ok(());
    }
    let Some(before) = summary.strip_suffix(&end(Some(refined))?) else { return Ok(()) };
    summary.truncate(before.len());
    summary.push_str(&end(None)?);
    let checksum = half_checksum(&summary) | of_steps;
    let unlinked = sqlx::query("UPDATE policies SET summary = $2, checksum = $3 WHERE id = $1");
    unlinked.bind(id).bind(summary).bind(checksum).execute(connection).await?;
    Ok(())
}

/// Policies that are stored in up to so many bytes are read at once, without asking for their size first.
const MAX_INLINE_BYTES: usize = 32 * 1024;

/// Policies of up to so many bytes are written on the caller's thread, which takes a millisecond or so; larger ones on a blocking thread.
const MAX_INLINE_ANSWER_BYTES: usize = 1 << 20;

#[cfg(test)]
impl NewPolicy {
    /// An optimal policy of the model "m", with this summary and without steps.
    pub(crate) fn plain(id: &str, summary: &str, created_at: Timestamp) -> Self {
        let class = PolicyClass { model: "m".to_owned(), learner: None, status: Status::Optimal };
        Self { id: id.to_owned(), class, summary: summary.to_owned(), steps: Vec::new(), created_at }
    }
}

#[cfg(test)]
mod tests;
