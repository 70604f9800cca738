//! Which values the states of a body have, and which of them is closest to an observed one.

use std::collections::HashMap;

use super::Reached;
use super::report::Span;
use crate::attribute::{Attribute, Cycle, Kind, Scalar, Value};
use crate::interrupt::{Interrupted, Meter};
use crate::model::Model;

/// Most values that are listed of an attribute.
const MAX_LISTED: usize = 32;

/// The values that states have, by attribute.
#[derive(Debug)]
pub(super) struct Values<'m> {
    model: &'m Model,
    of: Vec<Of<'m>>,
}

/// Those of one attribute.
#[derive(Debug)]
enum Of<'m> {
    /// Numbers on a line, or on a circle with their places on it; ascending, each with where it stands in the domain.
    Ordered { places: Vec<(f64, u32)>, period: Option<f64> },
    /// Values that are equal or not, with where each stands. Hashed with a seed, as clients choose them.
    Apart { positions: HashMap<&'m Value, u32>, first: u32 },
}

impl<'m> Values<'m> {
    /// Those of the states that were reached, if these are all; else of all that states may have.
    pub(super) fn of(model: &'m Model, reached: &Reached<'_>, meter: &mut Meter<'_>) -> Result<Self, Interrupted> {
        if reached.extent != super::Extent::Whole {
            return Ok(Self::of_domains(model));
        }
        let mut is_used: Vec<Vec<bool>> =
            (0..model.schema().len()).map(|position| vec![false; model.states().domain(position).len()]).collect();
        #[expect(clippy::cast_possible_truncation, reason = "limits keep states far below 2^32")]
        for state in 0..reached.n_states() as u32 {
            let row = reached.row(state);
            meter.spend_or_stop(row.len() as u64)?;
            for (is_used, value) in is_used.iter_mut().zip(row) {
                is_used[*value as usize] = true;
            }
        }
        Ok(Self::among(model, |position, value| is_used[position][value]))
    }

    /// All that states may have; not all need be reached.
    pub(super) fn of_domains(model: &'m Model) -> Self {
        Self::among(model, |_, _| true)
    }

    fn among(model: &'m Model, is_used: impl Fn(usize, usize) -> bool) -> Self {
        let of = model.schema().attributes().iter().enumerate().map(|(position, attribute)| {
            let domain = model.states().domain(position).iter().zip(0u32..);
            let used = domain.filter(|(_, at)| is_used(position, *at as usize));
            Of::new(attribute, used)
        });
        Self { model, of: of.collect() }
    }

    /// How many values there are of the attribute at `position`.
    pub(super) fn n_values(&self, position: usize) -> u64 {
        self.of[position].positions().count() as u64
    }

    /// From where to where numbers go.
    pub(super) fn span(&self, position: usize) -> Option<Span> {
        let domain = self.model.states().domain(position);
        let numbers = self.of[position].positions().filter_map(|at| match &domain[at as usize] {
            Value::Number(number) => Some(*number),
            _ => None,
        });
        numbers
            .map(|number| Span { least: number, greatest: number })
            .reduce(|one, other| Span { least: one.least.min(other.least), greatest: one.greatest.max(other.greatest) })
    }

    /// The values, if they are few and no numbers.
    pub(super) fn list(&self, position: usize) -> Option<Vec<Scalar>> {
        let (attribute, domain) = (&self.model.schema().attributes()[position], self.model.states().domain(position));
        let mut positions: Vec<u32> = self.of[position].positions().collect();
        let are_numbers = domain.iter().any(|value| matches!(value, Value::Number(_)));
        if are_numbers || positions.len() > MAX_LISTED {
            return None;
        }
        if !self.of[position].is_ordered() {
            positions.sort_unstable();
        }
        Some(positions.iter().map(|at| attribute.write_value(&domain[*at as usize])).collect())
    }

    /// Where the value stands in the domain that is closest to an observed one, and by how much it differs: [`Attribute::delta`].
    pub(super) fn closest(&self, position: usize, observed: &Value) -> (u32, f64) {
        let (attribute, domain) = (&self.model.schema().attributes()[position], self.model.states().domain(position));
        let own = |at: u32| (at, attribute.delta(observed, &domain[at as usize]));
        match &self.of[position] {
            Of::Apart { positions, first } => own(positions.get(observed).copied().unwrap_or(*first)),
            Of::Ordered { places, period } => {
                let place = place_of(observed, *period);
                let next = places.partition_point(|(other, _)| *other < place);
                // On a circle, the last stands before the first.
                let around =
                    [next.checked_sub(1).unwrap_or(places.len() - 1), if next < places.len() { next } else { 0 }];
                let [before, after] = around.map(|n| own(places[n].1));
                if before.1 <= after.1 { before } else { after }
            }
        }
    }
}

impl<'m> Of<'m> {
    fn new(attribute: &Attribute, used: impl Iterator<Item = (&'m Value, u32)>) -> Self {
        let period = match &attribute.kind {
            Kind::Category => {
                let positions: HashMap<&Value, u32> = used.collect();
                let first = positions.values().copied().min().unwrap_or(0);
                return Self::Apart { positions, first };
            }
            Kind::Number { .. } => None,
            Kind::Cyclic { cycle, .. } => Some(Cycle::period(cycle)),
        };
        let mut places: Vec<(f64, u32)> = used.map(|(value, at)| (place_of(value, period), at)).collect();
        places.sort_unstable_by(|one, other| one.0.total_cmp(&other.0).then(one.1.cmp(&other.1)));
        Self::Ordered { places, period }
    }

    fn is_ordered(&self) -> bool {
        matches!(self, Self::Ordered { .. })
    }

    /// Where its values stand in the domain.
    fn positions(&self) -> Box<dyn Iterator<Item = u32> + '_> {
        match self {
            Self::Ordered { places, .. } => Box::new(places.iter().map(|(_, at)| *at)),
            Self::Apart { positions, .. } => Box::new(positions.values().copied()),
        }
    }
}

/// Where a number or a label stands on its line or circle.
fn place_of(value: &Value, period: Option<f64>) -> f64 {
    let place = match value {
        Value::Number(number) => *number,
        Value::Label(label) => f64::from(*label),
        Value::Text(_) | Value::Integer(_) | Value::Boolean(_) => 0.0,
    };
    period.map_or(place, |period| place.rem_euclid(period))
}
