//! What of a demonstration a body can never meet, and what that costs at least.

use std::collections::HashMap;

use super::report::{DemonstrationReport, Unknown, UnmetReport, UnmetValue};
use super::{Classes, Query, Reached, Values};
use crate::attribute::{MAX_COST, Value};
use crate::document::Path;
use crate::interrupt::{Interrupted, Meter};
use crate::mapping::{Conditions, Demonstration, Distances, Watch};
use crate::model::Model;

/// Most values that are listed of an attribute, and most observations.
const MAX_LISTED: usize = 20;

/// How many terms of distances are looked at: about two seconds.
const MAX_TERMS: u64 = 1 << 30;

/// What was observed of each attribute, and what no state has of it.
pub(super) fn by_attribute(
    model: &Model,
    query: &Query,
    seen: &Demonstration,
    values: &Values<'_>,
    meter: &mut Meter<'_>,
) -> Result<Vec<UnmetReport>, Interrupted> {
    let weighted = model.schema().attributes().iter().zip(query.weights.as_slice()).enumerate();
    let report = |(position, (attribute, weight)): (usize, (&crate::attribute::Attribute, &f64))| {
        let domain = model.states().domain(position);
        // By value, the least term, and where it is listed; `None` if a state has it.
        let mut found: HashMap<&Value, (f64, Option<usize>)> = HashMap::new();
        let mut unmet = UnmetReport { name: attribute.name.clone(), ..UnmetReport::default() };
        for (index, observation) in seen.iter().enumerate() {
            meter.spend_or_stop(1)?;
            let Some(value) = &observation[position] else { continue };
            unmet.observed += 1;
            let (term, listed) = *found.entry(value).or_insert_with(|| {
                let (closest, delta) = values.closest(position, value);
                if delta == 0.0 {
                    return (0.0, None);
                }
                let closest = &domain[closest as usize];
                if unmet.values.len() < MAX_LISTED {
                    let [value, closest] = [value, closest].map(|value| attribute.write_value(value));
                    unmet.values.push(UnmetValue { value, closest, observations: 0, first: index as u64 });
                }
                unmet.distinct += 1;
                (attribute.term(*weight, value, closest), usize::try_from(unmet.distinct - 1).ok())
            });
            if let Some(listed) = listed {
                unmet.unmet += 1;
                unmet.values.get_mut(listed).into_iter().for_each(|value| value.observations += 1);
            }
            unmet.distance += (query.conditions.observation_weight(index) * term).min(MAX_COST);
        }
        Ok(unmet)
    };
    weighted.map(report).collect()
}

/// What no state meets, all attributes together.
#[derive(Debug, Default)]
pub(super) struct Together {
    n_met: u64,
    /// The first observations that no state meets.
    unmet: Vec<u64>,
    distance: f64,
}

impl Together {
    /// Looks for the state that is closest to each observation. Nothing if that would take too long.
    pub(super) fn of(
        model: &Model,
        query: &Query,
        seen: &Demonstration,
        reached: &Reached<'_>,
        values: &Values<'_>,
        meter: &mut Meter<'_>,
    ) -> Result<Option<Self>, Interrupted> {
        // Whether one is met does not depend on its weight.
        let distances = Distances::new(model.schema(), reached.states(), seen, &query.weights, &Conditions::default());
        let active: Vec<usize> = (0..model.schema().len()).filter(|position| distances.is_active(*position)).collect();
        let classes = Classes::of(reached, active.clone(), meter)?;
        let (mut together, mut n_left) = (Self::default(), MAX_TERMS);
        let mut known: HashMap<Vec<Option<&Value>>, f64> = HashMap::new();
        for (index, observation) in seen.iter().enumerate() {
            let observed: Vec<Option<&Value>> = active.iter().map(|at| observation[*at].as_ref()).collect();
            let least = if let Some(least) = known.get(&observed) {
                *least
            } else {
                let closest = Closest::of(model, query, values, &active, &observed);
                let least =
                    closest.least(reached, &classes, &mut n_left, meter, |row| distances.distance(index, row))?;
                let Some(least) = least else { return Ok(None) };
                known.insert(observed, least);
                least
            };
            if least == 0.0 {
                together.n_met += 1;
            } else if together.unmet.len() < MAX_LISTED {
                together.unmet.push(index as u64);
            }
            together.distance += (query.conditions.observation_weight(index) * least).min(MAX_COST);
        }
        Ok(Some(together))
    }
}

/// Of each attribute that was observed, the value that is closest to what was.
struct Closest {
    /// The sum of their terms: no state is closer.
    bound: f64,
    /// The row of a state with these values; `None` if an attribute that counts was not observed.
    row: Option<Vec<u32>>,
    n_observed: u64,
}

impl Closest {
    fn of(model: &Model, query: &Query, values: &Values<'_>, active: &[usize], observed: &[Option<&Value>]) -> Self {
        let mut closest = Self { bound: 0.0, row: Some(vec![0; model.schema().len()]), n_observed: 0 };
        for (position, value) in active.iter().zip(observed) {
            let Some(value) = value else {
                closest.row = None;
                continue;
            };
            let (at, _) = values.closest(*position, value);
            let own = &model.states().domain(*position)[at as usize];
            let weight = query.weights.as_slice()[*position];
            closest.bound += model.schema().attributes()[*position].term(weight, value, own);
            closest.row.iter_mut().for_each(|row| row[*position] = at);
            closest.n_observed += 1;
        }
        closest
    }

    /// The least distance of a state. Nothing if no more terms may be looked at.
    fn least(
        &self,
        reached: &Reached<'_>,
        classes: &Classes,
        n_left: &mut u64,
        meter: &mut Meter<'_>,
        distance: impl Fn(&[u32]) -> f64,
    ) -> Result<Option<f64>, Interrupted> {
        if self.row.as_ref().is_some_and(|row| classes.find(reached, row).is_some()) {
            return Ok(Some(self.bound));
        }
        let mut least = f64::INFINITY;
        for first in &classes.first {
            meter.spend_or_stop(1 + self.n_observed)?;
            let Some(left) = n_left.checked_sub(1 + self.n_observed) else { return Ok(None) };
            *n_left = left;
            least = least.min(distance(reached.row(*first)));
            if least <= self.bound {
                break;
            }
        }
        Ok(Some(least))
    }
}

/// What was found.
pub(super) fn report(
    model: &Model,
    query: &Query,
    seen: &Demonstration,
    attributes: Vec<UnmetReport>,
    together: Option<Together>,
) -> DemonstrationReport {
    let mut watch = Watch::new(&query.weights);
    for (index, observation) in seen.iter().enumerate() {
        watch.observe(model, index, observation);
    }
    DemonstrationReport {
        observations: seen.len() as u64,
        met: together.as_ref().map(|together| together.n_met),
        distance: together.as_ref().map(|together| together.distance),
        unmet: together.map(|together| together.unmet),
        attributes,
        warnings: watch.warnings(model, &Path::Member(&Path::Root, "demonstration")),
    }
}

impl Unknown {
    /// Of the distance, all attributes together.
    pub(super) fn no_distance(is_whole: bool) -> Self {
        let detail = if is_whole {
            "to compare every observation with every state takes longer than there is time for; the distances by attribute hold"
        } else {
            "not all states are known, so that observations are compared attribute by attribute alone"
        };
        Self { pointer: "/demonstration/distance".to_owned(), detail: detail.to_owned() }
    }
}
