use serde_json::{Value, json};

use super::*;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Limits, Model};

#[test]
fn what_is_mapped_where_it_arrives_is_measured_by_transitions_too() {
    let size = |definition: &Value| {
        let definition = Definition::read(definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        model.graph().n_states() + model.graph().n_transitions()
    };
    let lookahead = NonZeroU32::new(8);
    let cave = size(&json!({"dynamics": {"kind": "wumpus", "width": 7, "height": 4, "gold": [[5, 0]]}}));
    assert!(is_inline(cave, lookahead, 1) && !is_inline(cave, lookahead, 1000), "{cave}");
    // Few states, between any two of which an action leads.
    let n_states = 100;
    let action = |n: usize| json!({"name": format!("to {n}")});
    let transitions = (0..n_states).flat_map(|from| (0..n_states).map(move |to| json!([from, to, to])));
    let complete = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": (0..n_states).map(action).collect::<Vec<_>>(),
        "dynamics": {
            "kind": "table", "states": (0..n_states).map(|x| json!([x])).collect::<Vec<_>>(),
            "transitions": transitions.collect::<Vec<_>>(),
        },
    });
    assert!(!is_inline(size(&complete), lookahead, 1));
}
