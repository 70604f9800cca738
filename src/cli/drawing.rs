//! `--picture`: a policy and its demonstration as a picture.

use std::path::PathBuf;

use clap::Args;

use super::{CliError, render, write_file};
use crate::picture::{Moment, Paths, Stop, Timeline};
use etude_core::attribute::{Attribute, ByAttribute, Kind, Scalar, Value};
use etude_core::mapping::{Policy, Problem};
use etude_core::model::Model;

/// Flags that ask for a picture.
#[derive(Args, Debug)]
pub(super) struct PictureFlags {
    /// Draw a picture (SVG): both paths in the plane of two number attributes if the model has them, else which step belongs to which
    /// observation.
    #[arg(long, value_name = "FILE")]
    picture: Option<PathBuf>,
    /// The attribute that is drawn to the right [default: x, else the first number].
    #[arg(long, value_name = "ATTRIBUTE", requires = "picture")]
    picture_x: Option<String>,
    /// The attribute that is drawn upwards [default: y, else the second number].
    #[arg(long, value_name = "ATTRIBUTE", requires = "picture")]
    picture_y: Option<String>,
}

impl PictureFlags {
    /// Draws what is asked for: `policy`, which solves `problem` for a body that `model` describes.
    pub(super) fn draw(&self, policy: &Policy, model: &Model, problem: &Problem<'_>) -> Result<(), CliError> {
        let Some(path) = &self.picture else { return Ok(()) };
        let attributes = model.schema().attributes();
        let title = [title(policy), subtitle(policy)];
        let svg = match self.axes(attributes)? {
            Some(axes) => paths(policy, model, problem, axes, title)?.draw()?,
            None if policy.steps.len() > Timeline::MAX_STEPS => {
                let (n_steps, most) = (policy.steps.len(), Timeline::MAX_STEPS);
                let detail =
                    format!("--picture: the policy has {n_steps} steps, and no picture shows more than {most}");
                return Err(CliError::Faulty(detail));
            }
            None => timeline(policy, model, problem, title).draw()?,
        };
        write_file(path, &svg)
    }

    /// Positions of the two attributes that span the plane; `None` if there are none.
    fn axes(&self, attributes: &[Attribute]) -> Result<Option<[usize; 2]>, CliError> {
        let is_number = |position: &usize| matches!(attributes[*position].kind, Kind::Number { .. });
        let numbers: Vec<usize> = (0..attributes.len()).filter(is_number).collect();
        let named = |name: &str| numbers.iter().copied().find(|position| attributes[*position].name == name);
        let asked = |flag: &str, name: &Option<String>| match name {
            None => Ok(None),
            Some(name) => named(name).map(Some).ok_or_else(|| {
                let known: Vec<_> =
                    numbers.iter().map(|position| format!("{:?}", attributes[*position].name)).collect();
                let detail = format!("{name:?} is no number attribute; the model has {}", known.join(", "));
                CliError::Faulty(format!("{flag} {name}: {detail}"))
            }),
        };
        let (x, y) = (asked("--picture-x", &self.picture_x)?, asked("--picture-y", &self.picture_y)?);
        let first = |name: &str, other: Option<usize>| {
            named(name).filter(|position| Some(*position) != other).or_else(|| {
                numbers.iter().copied().find(|position| Some(*position) != other && Some(*position) != named("y"))
            })
        };
        let x = x.or_else(|| first("x", y));
        let y = y.or_else(|| {
            let other = numbers.iter().copied().find(|position| Some(*position) != x);
            named("y").filter(|position| Some(*position) != x).or(other)
        });
        Ok(x.zip(y).map(|(x, y)| [x, y]))
    }
}

fn title(policy: &Policy) -> String {
    format!("{}: cost {}", policy.model, render::sum(&policy.cost))
}

fn subtitle(policy: &Policy) -> String {
    let coverage = &policy.coverage;
    format!(
        "{}; {} of {} observations met exactly, {} actions",
        policy.status.name(),
        coverage.exact,
        coverage.observed,
        policy.actions.len()
    )
}

fn paths(
    policy: &Policy,
    model: &Model,
    problem: &Problem<'_>,
    axes: [usize; 2],
    title: [String; 2],
) -> Result<Paths, CliError> {
    let attributes = model.schema().attributes();
    let seen = |observation: &[Option<Value>], position: usize| match observation[position] {
        Some(Value::Number(number)) => Some(number),
        _ => None,
    };
    let names = axes.map(|position| attributes[position].name.clone());
    let number = |state: &ByAttribute<Scalar>, name: &str| match state.get(name) {
        #[expect(clippy::cast_precision_loss, reason = "numbers are floats")]
        Some(Scalar::Integer(integer)) => Some(*integer as f64),
        Some(Scalar::Number(number)) => Some(*number),
        _ => None,
    };
    let stops = policy.steps.iter().map(|step| {
        let at = number(&step.state, &names[0]).zip(number(&step.state, &names[1]))?;
        let action = step.action.as_deref().map(str::to_owned);
        Some(Stop { at, observation: step.observation as usize, action })
    });
    let imitation: Option<Vec<_>> = stops.collect();
    let mut demonstration = Vec::new();
    for (number, observation) in observed(problem) {
        demonstration.resize(number, None);
        demonstration.push(seen(observation, axes[0]).zip(seen(observation, axes[1])));
    }
    Ok(Paths {
        title,
        demonstration,
        imitation: imitation.ok_or_else(|| CliError::Faulty("--picture: a number of the policy is none".to_owned()))?,
        axes: names,
    })
}

/// The observations that are followed, each with its number in the whole demonstration.
fn observed<'p>(problem: &'p Problem<'_>) -> impl Iterator<Item = (usize, &'p [Option<Value>])> {
    (0..).zip(problem.demonstration().iter()).map(|(n, observation)| (problem.number_of(n) as usize, observation))
}

fn timeline(policy: &Policy, model: &Model, problem: &Problem<'_>, title: [String; 2]) -> Timeline {
    let schema = model.schema();
    let written = |observation: &[Option<Value>]| {
        let values = observation.iter().zip(schema.attributes());
        schema.by_some_attributes(values.map(|(value, attribute)| Some(attribute.write_value(value.as_ref()?))))
    };
    let mut observations = Vec::new();
    let mut before = None;
    for (number, observation) in observed(problem) {
        let state = written(observation);
        observations.resize(number, String::new());
        observations.push(shortened(render::changes(Some(&policy.weights), before.as_ref(), &state)));
        before = Some(state);
    }
    let steps = policy.steps.iter().map(|step| Moment {
        observation: step.observation as usize,
        kind: render::name(step.kind),
        words: match &step.action {
            Some(action) => action.to_string(),
            None if step.step == 0 => "start".to_owned(),
            None => String::new(),
        },
        is_exact: step.distance == 0.0,
    });
    Timeline { title, observations, steps: steps.collect() }
}

/// So much of a text that there is room for it.
fn shortened(text: String) -> String {
    const MOST: usize = 40;
    if text.chars().count() <= MOST { text } else { text.chars().take(MOST - 2).chain([' ', '…']).collect() }
}
