//! From nothing to a policy: a corridor with a door, a demonstrator that walks through it, an imitator that must open it first.
//!
//! `cargo run -p etude-core --example corridor`

#![expect(clippy::print_stdout, reason = "this is what an example is for")]

use etude_core::attribute::{Attribute, BuildError, Schema};
use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::{Conditions, Demonstration, Mapper, Problem, Settings};
use etude_core::model::ModelBuilder;

fn main() -> Result<(), BuildError> {
    let schema = Schema::new([Attribute::number("x"), Attribute::category("door")])?;
    let mut body = ModelBuilder::new(schema.clone());
    let (forward, open) = (body.action("forward", 0.3)?, body.action("open", 0.5)?);
    let shut: Vec<_> = (0..4).map(|x| body.state([x.into(), "shut".into()])).collect::<Result<_, _>>()?;
    let opened: Vec<_> = (0..4).map(|x| body.state([x.into(), "open".into()])).collect::<Result<_, _>>()?;
    body.transition(shut[0], forward, shut[1])?;
    body.transition(shut[1], open, opened[1])?;
    for x in 0..3 {
        body.transition(opened[x], forward, opened[x + 1])?;
    }
    body.start_at([shut[0]])?;
    let mapper = Mapper::new(body.build()?, &mut Uninterrupted).expect("nothing interrupts it");

    // What was seen: where the demonstrator was. Its door was never looked at.
    let demonstration = Demonstration::new(&schema, (0..4).map(|x| [Some(x.into()), None]))?;
    let problem = Problem::new(mapper.model(), demonstration, schema.weights(), Conditions::default());
    let mapping = mapper.map(&problem, Settings::default(), &mut Uninterrupted).expect("nothing interrupts it");
    for step in &mapping.moves {
        let action = step.action.map_or("-".into(), |action| mapper.model().action_name(action));
        let state = mapper.model().describe(step.state);
        let values: Vec<String> = state.iter().map(|(name, value)| format!("{name} {value}")).collect();
        println!("observation {}: {action:8} {}", step.observation, values.join(", "));
    }
    println!("cost {} ({:?})", mapping.cost.total, mapping.status);
    Ok(())
}
