//! Items of a batch, as they wait.

use serde_json::Value;
use tokio_util::bytes::Bytes;

use crate::service::requests::{SentRequest, n_observations};
use etude_core::document::{self, Faults, Members, Path, Place};
use etude_core::mapping::{Demonstration, Options, Perception, RequestKind, WellFormed};
use etude_core::model::Model;

/// An item that waits.
#[derive(Debug)]
pub(super) struct Item {
    /// Its options; all of it, if its demonstration is still to be read.
    pub(super) document: Value,
    pub(super) read: Option<ReadItem>,
    /// What of its demonstration cannot be observed.
    pub(super) faults: Faults,
}

/// An item whose demonstration was read.
#[derive(Debug)]
pub(super) struct ReadItem {
    pub(super) demonstration: Demonstration,
    /// Its text.
    pub(super) observed: Bytes,
}

impl Item {
    /// Reads the item in `text`, of about `n_values` and no more than `max_len` observations. Nothing if it cannot even be read as a document.
    pub(super) fn read(
        sent: &SentRequest,
        text: &str,
        (model, shared, n): (&Model, &Options, usize),
        max_len: usize,
        n_values: usize,
    ) -> Option<Self> {
        let members = Members::split(text, RequestKind::Item.fields());
        let read = members.and_then(|mut members| {
            let has_own = members.take("observe").is_some_and(|text| text != "null");
            if has_own || shared.observe.is_some() {
                return None;
            }
            let observed = members.take("demonstration")?;
            let well_formed = WellFormed { schema: model.schema(), n_values, max_len };
            let read =
                ReadItem { demonstration: well_formed.read(observed).ok()?, observed: sent.observed_part(observed) };
            Some(Self { document: members.parse()?, read: Some(read), faults: Faults::default() })
        });
        read.or_else(|| Self::parse(text, shared, n))
    }

    /// The item at `n`, in `text`, as a document, with what is observed of its demonstration if that says how, or else `shared` does.
    pub(super) fn parse(text: &str, shared: &Options, n: usize) -> Option<Self> {
        let mut document = document::parse(text.as_bytes()).ok()?;
        let mut faults = Faults::default();
        let items = Path::Member(&Path::Root, "items");
        let path = Path::Item(&items, n);
        let (own_path, shared_path) = (Path::Member(&path, "observe"), Path::Member(&Path::Root, "observe"));
        let own = document.get("observe").filter(|observe| !observe.is_null()).map(|observe| {
            // What is wrong with it, the options tell.
            Perception::read(&Place::root(observe), &mut Faults::default())
        });
        let (perception, observe_path) = match &own {
            Some(own) => (own.as_ref(), own_path),
            None => (shared.observe.as_deref(), shared_path),
        };
        if let (Some(perception), Some(demonstration)) = (perception, document.get("demonstration")) {
            let place = Place { value: demonstration, path: Path::Member(&path, "demonstration") };
            if let Some(observed) = perception.observe_all(&place, &observe_path, &mut faults) {
                document["demonstration"] = observed;
                document["observe"] = Value::Null;
            }
        }
        Some(Self { document, read: None, faults })
    }

    /// How many observations its demonstration has.
    pub(super) fn n_observations(&self) -> usize {
        match &self.read {
            Some(read) => read.demonstration.len(),
            None => n_observations(&self.document),
        }
    }

    /// How much memory it takes, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        let demonstration_bytes = self.read.as_ref().map_or(0, |read| read.demonstration.size_bytes());
        document::size_bytes(&self.document) + 2 * size_of_val(self) + demonstration_bytes + self.faults.size_bytes()
    }
}
