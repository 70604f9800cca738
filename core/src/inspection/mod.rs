//! Inspection: what can be said of a body before it follows anything, and what of a demonstration it can never meet.
//!
//! ```text
//! Model, Query --walk--> Reached (states, ways) --parts--> Parts        where it can go to and fro, what it cannot leave
//!                           |                 '--undoing-> Undoing      how many actions undo one: the lookahead of streams
//!                           '------ demonstration -------> Unmet        observations that no state meets, and what they cost at least
//!                                                              '------> Report
//! ```
//!
//! | file | is |
//! |---|---|
//! | `query` | what is asked: a body, weights, perhaps a demonstration |
//! | `reached` | the states that the body comes to, and the ways between them |
//! | `classes` | states that look alike |
//! | `parts` | strongly connected components |
//! | `one_way` | attributes that change one way only, where states are not listed |
//! | `undoing` | how many actions it takes until all looks as before one |
//! | `values`, `unmet` | which values states have; what was observed that none has |
//! | `report` | what was found |
//!
//! All figures are exact unless the report says otherwise: of a world that is searched lazily and of a very large model, some are found by a
//! stated sample, and some are not found; these are `null`, and [`Report::unknown`] says why.

mod classes;
mod one_way;
mod parts;
mod query;
mod reached;
mod report;
mod undoing;
mod unmet;
mod values;

pub use query::Query;
pub use report::{
    ActionReport, AttributeReport, DemonstrationReport, Part, PartsReport, ReachReport, Report, ReportCounts, Span,
    StateExample, StatesReport, Steps, UndoReport, Unknown, UnmetReport, UnmetValue,
};

use crate::attribute::{Attribute, AttributeDocument};
use crate::interrupt::{Cancelled, Interrupt, Interrupted, Meter};
use crate::mapping::{Demonstration, Starts};
use crate::model::Model;
use classes::Classes;
use one_way::OneWay;
use parts::Parts;
use reached::{Effects, Extent, Reached};
use undoing::Undoing;
use values::Values;

/// How many states or transitions are looked at between two looks at the interrupt: less than a millisecond.
const POLL_EVERY: u64 = 1 << 12;

/// About how much memory an inspection of `model` takes, besides that of a demonstration, in bytes.
#[must_use]
pub fn inspection_bytes(model: &Model) -> usize {
    /// Numbers of states both ways, parts of states and of those that look alike, what a search has seen, and the index of those.
    const STATE_BYTES: usize = 96;
    /// A way, and one between states that look alike.
    const TRANSITION_BYTES: usize = 16;
    let lazily = if model.is_lazy() { reached::MAX_EXPLORED } else { 0 };
    let n_states = model.graph().n_states() + lazily * model.actions().len().max(1);
    let n_transitions = model.graph().n_transitions() + lazily * model.actions().len();
    n_states * (STATE_BYTES + model.schema().len() * size_of::<u32>()) + n_transitions * TRANSITION_BYTES
}

/// Inspects the body that `query` tells of. If `interrupt` says to finish before all is found, the report says what is not.
///
/// ```
/// use etude_core::attribute::{Attribute, Schema};
/// use etude_core::inspection::{Query, inspect};
/// use etude_core::interrupt::Uninterrupted;
/// use etude_core::mapping::Demonstration;
/// use etude_core::model::ModelBuilder;
///
/// // A ring of four cells, which can be gone round one way only.
/// let schema = Schema::new([Attribute::number("x")])?;
/// let mut body = ModelBuilder::new(schema.clone());
/// let on = body.action("on", 0.3)?;
/// let cells: Vec<_> = (0..4).map(|x| body.state([x.into()])).collect::<Result<_, _>>()?;
/// for n in 0..4 {
///     body.transition(cells[n], on, cells[(n + 1) % 4])?;
/// }
/// let model = body.build()?;
/// let seen = Demonstration::new(&schema, [1, 7, 3].map(|x| [Some(x.into())]))?;
/// let query = Query { demonstration: Some(seen), ..Query::of(&model) };
/// let report = inspect(&model, &query, &mut Uninterrupted)?;
///
/// // Three actions undo one, so that a stream must see four observations ahead to know that it is worth it.
/// assert_eq!((report.undo.unwrap().steps.unwrap().greatest, report.lookahead), (3, Some(4)));
/// let unmet = report.demonstration.unwrap();
/// assert_eq!((unmet.met, unmet.distance), (Some(2), Some(16.0)));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
///
/// # Errors
///
/// [`Cancelled`] if `interrupt` said so.
///
/// # Panics
///
/// If the query names states or actions that the model does not have.
pub fn inspect(model: &Model, query: &Query, interrupt: &mut dyn Interrupt) -> Result<Report, Cancelled> {
    let mut meter = Meter::new(interrupt, POLL_EVERY);
    let mut unknown = Vec::new();
    let starts = Starts::of(model, query.conditions.starts.as_deref());
    let reached = in_time(Reached::walk(model, &query.conditions, &starts, &mut meter))?;
    let whole = reached.as_ref().filter(|reached| reached.extent == Extent::Whole);
    match &reached {
        None => unknown.push(Unknown::out_of_time("/reach")),
        Some(reached) if whole.is_none() => unknown.push(Unknown::lazy(reached)),
        Some(_) => {}
    }
    let effects = match whole {
        Some(whole) => in_time(Effects::of(model, whole, &mut meter))?,
        None => None,
    };
    let values = match &reached {
        Some(reached) => in_time(Values::of(model, reached, &mut meter))?,
        None => None,
    };
    let values = values.unwrap_or_else(|| Values::of_domains(model));
    let of_states = match whole {
        Some(whole) => in_time(Parts::of(whole, &mut meter))?,
        None => None,
    };
    if whole.is_some() && of_states.is_none() {
        unknown.push(Unknown::out_of_time("/parts"));
    }
    let undoing = match &reached {
        Some(reached) => in_time(Undoing::of(model, reached, of_states.as_ref(), query, &mut meter))?,
        None => None,
    };
    match &undoing {
        None => unknown.push(Unknown::out_of_time("/undo")),
        Some(undoing) => unknown.extend(undoing.unknown()),
    }
    let demonstration = match &query.demonstration {
        Some(seen) => Some(inspect_demonstration(model, query, seen, whole, &values, &mut meter, &mut unknown)?),
        None => None,
    };
    Ok(Report {
        model: String::new(),
        model_hash: String::new(),
        weights: model.schema().by_attribute(query.weights.as_slice().iter().copied()),
        counts: ReportCounts::of(model),
        reach: whole.map(|whole| ReachReport::of(model, whole)),
        parts: whole.zip(of_states.as_ref()).map(|(whole, parts)| PartsReport::of(model, whole, parts)),
        attributes: attributes(model, query, effects.as_ref(), &values),
        actions: actions(model, query, effects.as_ref(), undoing.as_ref()),
        lookahead: undoing.as_ref().and_then(Undoing::lookahead),
        undo: undoing.map(|undoing| undoing.report()),
        demonstration,
        unknown,
    })
}

/// What was found, if that was before the time was up.
fn in_time<T>(found: Result<T, Interrupted>) -> Result<Option<T>, Cancelled> {
    match found {
        Ok(found) => Ok(Some(found)),
        Err(Interrupted::OutOfTime) => Ok(None),
        Err(Interrupted::Cancelled(cancelled)) => Err(cancelled),
    }
}

fn attributes(model: &Model, query: &Query, effects: Option<&Effects>, values: &Values<'_>) -> Vec<AttributeReport> {
    let changed_by = match effects {
        Some(effects) => effects.n_changing.iter().copied().map(Some).collect(),
        None => reached::changed_by_operators(model, &query.conditions),
    };
    let attributes = model.schema().attributes().iter().zip(query.weights.as_slice()).zip(changed_by).enumerate();
    let report = |(position, ((attribute, weight), changed_by)): (_, ((&Attribute, &f64), _))| AttributeReport {
        name: attribute.name.clone(),
        kind: AttributeDocument::from(attribute).kind,
        weight: *weight,
        hidden: attribute.is_hidden,
        distinct: values.n_values(position),
        span: values.span(position),
        values: values.list(position),
        changed_by,
    };
    attributes.map(report).collect()
}

fn actions(model: &Model, query: &Query, effects: Option<&Effects>, undoing: Option<&Undoing>) -> Vec<ActionReport> {
    let applies_in = match effects {
        Some(effects) => effects.n_applying.iter().copied().map(Some).collect(),
        None => reached::applying_by_operators(model),
    };
    let named = (0..).zip(model.actions().iter().zip(applies_in));
    let has = named.filter(|(action, _)| !query.conditions.without.contains(action));
    let report = |(action, (named, applies_in)): (_, (&crate::model::Action, _))| ActionReport {
        name: named.name.to_string(),
        cost: named.cost,
        applies_in,
        undone_in: undoing.and_then(|undoing| undoing.of_action(action).greatest),
        never_undone: undoing.map(|undoing| undoing.of_action(action).n_never),
    };
    has.map(report).collect()
}

fn inspect_demonstration(
    model: &Model,
    query: &Query,
    seen: &Demonstration,
    whole: Option<&Reached<'_>>,
    values: &Values<'_>,
    meter: &mut Meter<'_>,
    unknown: &mut Vec<Unknown>,
) -> Result<DemonstrationReport, Cancelled> {
    let attributes = in_time(unmet::by_attribute(model, query, seen, values, meter))?;
    let together = match whole.filter(|_| attributes.is_some()) {
        Some(whole) => in_time(unmet::Together::of(model, query, seen, whole, values, meter))?.flatten(),
        None => None,
    };
    if attributes.is_none() {
        unknown.push(Unknown::out_of_time("/demonstration/attributes"));
    }
    if together.is_none() {
        unknown.push(Unknown::no_distance(whole.is_some()));
    }
    Ok(unmet::report(model, query, seen, attributes.unwrap_or_default(), together))
}
