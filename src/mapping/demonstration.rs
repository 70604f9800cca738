//! What was seen of the demonstrator.

use crate::attribute::{Schema, Value};
use crate::document::{Faults, Place};

/// The observed states `o_0 .. o_n` of a demonstration, at least one. Nothing is known of the demonstrator's actions.
#[derive(Clone, Debug, PartialEq)]
pub struct Demonstration {
    /// Shape `[n_observations, n_attributes]`, row by row; `None` where an attribute was not observed.
    values: Vec<Option<Value>>,
    n_attributes: usize,
}

impl Demonstration {
    /// Most observations of a demonstration.
    pub const MAX_OBSERVATIONS: usize = 100_000;

    /// Reads a demonstration: an array of 1 to [`Self::MAX_OBSERVATIONS`] observations.
    pub fn read(schema: &Schema, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let items = place.array(faults)?;
        if items.is_empty() || items.len() > Self::MAX_OBSERVATIONS {
            let detail = format!("expected 1 to {} observations, found {}", Self::MAX_OBSERVATIONS, items.len());
            faults.note(place, detail);
            return None;
        }
        let n_before = faults.count();
        let mut values = Vec::with_capacity(items.len() * schema.len());
        for (n, item) in items.iter().enumerate() {
            values.extend(schema.read_observation(&place.item(n, item), faults).unwrap_or_default());
        }
        (faults.count() == n_before).then_some(Self { values, n_attributes: schema.len() })
    }

    /// How many observations there are: n + 1.
    #[must_use]
    #[expect(clippy::len_without_is_empty, reason = "it is never empty")]
    pub fn len(&self) -> usize {
        self.values.len() / self.n_attributes
    }

    /// A demonstration of these observations, each of shape `[n_attributes]`. `None` if there are none.
    #[must_use]
    pub fn of(observations: impl IntoIterator<Item = Vec<Option<Value>>>) -> Option<Self> {
        let mut observations = observations.into_iter().peekable();
        let n_attributes = observations.peek()?.len();
        Some(Self { values: observations.flatten().collect(), n_attributes })
    }

    /// The observations, in order.
    pub fn iter(&self) -> impl Iterator<Item = &[Option<Value>]> {
        self.values.chunks_exact(self.n_attributes)
    }

    /// The observation at `index`. Shape `[n_attributes]`.
    #[must_use]
    pub fn observation(&self, index: usize) -> &[Option<Value>] {
        &self.values[index * self.n_attributes..(index + 1) * self.n_attributes]
    }
}
