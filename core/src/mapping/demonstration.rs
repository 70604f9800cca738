//! What was seen of the demonstrator.

mod collapsed;
mod well_formed;

pub use well_formed::WellFormed;

use crate::attribute::{BuildError, Scalar, Schema, Value, check_count};
use crate::document::{Faults, Place, Repeated};

/// A demonstration, and the weights of its observations, as far as they are told.
pub type Weighted = (Demonstration, Vec<Option<f64>>);

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

    /// The demonstration of these observations: of each the values of a state, one for each attribute in order, `None` where it was not
    /// observed.
    ///
    /// ```
    /// use etude_core::attribute::{Attribute, Schema};
    /// use etude_core::mapping::Demonstration;
    ///
    /// let schema = Schema::new([Attribute::number("x"), Attribute::category("door")])?;
    /// let seen = Demonstration::new(&schema, [[Some(0.into()), Some("shut".into())], [Some(1.5.into()), None]])?;
    /// assert_eq!(seen.len(), 2);
    /// # Ok::<(), etude_core::attribute::BuildError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`BuildError::Count`] if there are none, more than [`Self::MAX_OBSERVATIONS`], or not one value for each attribute;
    /// [`BuildError::Value`] if one is none of its attribute's.
    pub fn new<O: IntoIterator<Item = Option<Scalar>>>(
        schema: &Schema,
        observations: impl IntoIterator<Item = O>,
    ) -> Result<Self, BuildError> {
        let mut values = Vec::new();
        let mut n_observations = 0;
        for observation in observations {
            let before = values.len();
            let mut attributes = schema.attributes().iter();
            for scalar in observation {
                // One too many is told below.
                let value = scalar.zip(attributes.next()).map(|(scalar, attribute)| attribute.value(scalar));
                values.push(value.transpose()?);
            }
            check_count("values", schema.len(), schema.len(), values.len() - before)?;
            n_observations += 1;
        }
        check_count("observations", 1, Self::MAX_OBSERVATIONS, n_observations)?;
        Ok(Self { values, n_attributes: schema.len() })
    }

    /// Reads a demonstration: an array of 1 to [`Self::MAX_OBSERVATIONS`] observations.
    pub fn read(schema: &Schema, place: &Place<'_, '_>, faults: &mut Faults) -> Option<Self> {
        let items = place.array(faults)?;
        if items.is_empty() || items.len() > Self::MAX_OBSERVATIONS {
            let detail = format!("expected 1 to {} observations, found {}", Self::MAX_OBSERVATIONS, items.len());
            faults.note(place, detail);
            return None;
        }
        let mut values = Vec::with_capacity(items.len() * schema.len());
        let items = items.iter().enumerate().map(|(n, item)| place.item(n, item));
        read_each(schema, items, faults, |observation| values.extend(observation))?;
        Some(Self { values, n_attributes: schema.len() })
    }

    /// Reads observations, each of shape `[n_attributes]`. What is wrong with several of them in the same way is told once.
    pub fn read_observations<'v, 'p>(
        schema: &Schema,
        places: impl ExactSizeIterator<Item = Place<'v, 'p>>,
        faults: &mut Faults,
    ) -> Option<Vec<Vec<Option<Value>>>> {
        let mut observations = Vec::with_capacity(places.len());
        read_each(schema, places, faults, |observation| observations.push(observation))?;
        Some(observations)
    }

    /// Reads observations that were read without faults before: arrays of them, one after the other, `n_observations` in all. A number
    /// before one is its weight. Gives them with their weights, as far as these are told. `None` if there are none.
    ///
    /// # Errors
    ///
    /// If they are something else.
    pub fn read_stored(
        schema: &Schema,
        texts: &[String],
        n_observations: usize,
    ) -> Result<Option<Weighted>, serde_json::Error> {
        let mut values = Vec::with_capacity(n_observations * schema.len());
        let mut weights = Vec::new();
        for text in texts {
            let first = values.len() / schema.len();
            let (read, of_text) = WellFormed::in_text(schema, text.len()).read_weighted(text)?;
            values.extend(read.values);
            if !of_text.is_empty() {
                weights.resize(first, None);
                weights.extend(of_text);
            }
        }
        Ok((!values.is_empty()).then_some((Self { values, n_attributes: schema.len() }, weights)))
    }

    /// About how many bytes a demonstration of so many observations takes, with what is looked up of them: little of it may be in the
    /// text that it is read from.
    #[must_use]
    pub fn bytes_of(schema: &Schema, n_observations: usize) -> usize {
        const VALUE_BYTES: usize = size_of::<Option<Value>>() + size_of::<u32>();
        n_observations.saturating_mul(schema.len() * VALUE_BYTES)
    }

    /// How many bytes of memory it takes.
    #[must_use]
    pub fn size_bytes(&self) -> usize {
        self.values.capacity() * size_of::<Option<Value>>()
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

    /// Appends an observation of shape `[n_attributes]`.
    pub(super) fn push(&mut self, observation: &[Option<Value>]) {
        self.values.extend_from_slice(observation);
    }

    /// Drops the first `n_observations`, and keeps at least one.
    pub(super) fn drop_first(&mut self, n_observations: usize) {
        let n_dropped = n_observations.min(self.len() - 1);
        self.values.drain(..n_dropped * self.n_attributes);
    }

    /// The observations, in order.
    pub fn iter(&self) -> impl Iterator<Item = &[Option<Value>]> {
        self.values.chunks_exact(self.n_attributes)
    }

    /// The observations, in order, each of shape `[n_attributes]`.
    pub fn into_observations(self) -> impl Iterator<Item = Vec<Option<Value>>> {
        let (n_observations, mut values) = (self.len(), self.values.into_iter());
        (0..n_observations).map(move |_| values.by_ref().take(self.n_attributes).collect())
    }

    /// The observation at `index`. Shape `[n_attributes]`.
    #[must_use]
    pub fn observation(&self, index: usize) -> &[Option<Value>] {
        &self.values[index * self.n_attributes..(index + 1) * self.n_attributes]
    }
}

/// Reads observations one by one. Those with faults, which are noted, are not to be used.
fn read_each<'v, 'p>(
    schema: &Schema,
    places: impl Iterator<Item = Place<'v, 'p>>,
    faults: &mut Faults,
    mut take: impl FnMut(Vec<Option<Value>>),
) -> Option<()> {
    let n_before = faults.count();
    let mut repeated = Repeated::default();
    for place in places {
        let mut own = Faults::default();
        take(schema.read_observation(&place, &mut own).unwrap_or_default());
        repeated.take_in(own, &place.path);
    }
    repeated.tell("observations", faults);
    (faults.count() == n_before).then_some(())
}
