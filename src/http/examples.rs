//! An example for each operation: what the page under `/docs/` is filled in with.
//!
//! Each works as it stands, after those of the operations that are listed before it; but for ids, which only the service knows, and for
//! experience, which another model is told. In place of ids stands [`AN_ID`], to be replaced by one that was answered.

use serde_json::{Value as Json, json};
use yaml_serde::Value;

/// Stands for an id that an operation before has answered.
const AN_ID: &str = "paste-an-id-here";

/// Gives an operation its example: its path's parameters, and its body.
pub(super) fn add(operation: &mut Value) {
    let is_experience = operation["operationId"] == "add_experience";
    let parameters = operation.get_mut("parameters").and_then(Value::as_sequence_mut);
    for parameter in parameters.into_iter().flatten().filter(|parameter| parameter["in"] == "path") {
        parameter["example"] = match parameter["name"].as_str() {
            Some("model") if is_experience => "explored",
            Some("model") => "corridor",
            Some("learner") => "doors",
            _ => AN_ID,
        }
        .into();
    }
    let body = operation.get("operationId").and_then(Value::as_str).and_then(body);
    let contents = operation.get_mut("requestBody").and_then(|body| body.get_mut("content"));
    // Where there are several types, the page begins with the first.
    let content = contents.and_then(Value::as_mapping_mut).and_then(|contents| contents.values_mut().next());
    if let (Some(content), Some(body)) = (content, body) {
        content["example"] = yaml_serde::to_value(body).unwrap_or_default();
    }
}

/// The body of the operation with this id.
fn body(operation_id: &str) -> Option<Json> {
    // The demonstrator walks through the door; whether it is open was not always seen.
    let demonstration = json!([{"x": 0, "heading": "east", "door": "shut"}, {"x": 1}, {"x": 2, "door": "open"}]);
    Some(match operation_id {
        "put_model" => json!({
            "attributes": [
                {"name": "x", "kind": "number"},
                {"name": "heading", "kind": "cyclic", "labels": ["east", "north", "west", "south"]},
                {"name": "door", "kind": "category"},
            ],
            "actions": [{"name": "forward", "cost": 0.3}, {"name": "push", "cost": 0.6}],
            "dynamics": {
                "kind": "table",
                "states": [[0, "east", "shut"], [1, "east", "shut"], [1, "east", "open"], [2, "east", "open"]],
                "transitions": [[0, "forward", 1], [1, "push", 2], [2, "forward", 3]],
                "start": 0,
            },
        }),
        "add_experience" => json!({
            "batch": "monday",
            "transitions": [
                {"state": {"x": 0, "door": "shut"}, "action": "forward", "next": {"x": 1, "door": "shut"}, "count": 9},
                {"state": {"x": 1, "door": "shut"}, "action": "push", "next": {"x": 1, "door": "open"}, "cost": 0.8},
            ],
        }),
        "make_report" => json!({"demonstration": demonstration}),
        "make_policy" => json!({"model": "corridor", "demonstration": demonstration, "weights": {"x": 2}}),
        "make_policies" => json!({
            "model": "corridor",
            "items": [{"demonstration": demonstration}, {"demonstration": demonstration, "weights": {"door": 0}}],
        }),
        "put_learner" => json!({"attributes": ["x", "door"], "seed": 7}),
        "make_trial" => json!({"model": "corridor", "demonstration": demonstration}),
        "put_reward" => json!({"reward": 974}),
        "fail_trial" => json!({"reason": "the battery is empty"}),
        "ndjson" => {
            let n_observations = demonstration.as_array().map(Vec::len);
            let frames = [
                json!({"type": "open", "model": "corridor", "lookahead": 2}),
                json!({"type": "observe", "seq": 0, "states": demonstration}),
                json!({"type": "end", "seq": n_observations}),
            ];
            frames.map(|frame| format!("{frame}\n")).concat().into()
        }
        _ => return None,
    })
}
