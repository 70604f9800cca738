//! A cave, told by rules.

use serde_json::{Value, json};

/// The rules of the wumpus world, written out for the cave `model`, after its description and not after its code.
pub(crate) fn cave_as_rules(model: &Value) -> Value {
    let cave = &model["dynamics"];
    let cells = |name: &str| -> Vec<(u64, u64)> {
        let cells = cave[name].as_array().unwrap().iter();
        cells.map(|cell| (cell[0].as_u64().unwrap(), cell[1].as_u64().unwrap())).collect()
    };
    let (pits, wumpi, gold) = (cells("pits"), cells("wumpi"), cells("gold"));
    let range = |to: u64| json!({"from": 0, "to": to});
    let (width, height) = (cave["width"].as_u64().unwrap(), cave["height"].as_u64().unwrap());
    let booleans = json!([false, true]);
    let mut attributes = vec![
        json!({"name": "x", "kind": "number", "values": range(width - 1)}),
        json!({"name": "y", "kind": "number", "values": range(height - 1)}),
        json!({"name": "heading", "kind": "cyclic", "labels": ["east", "north", "west", "south"]}),
        json!({"name": "gold", "kind": "number", "values": range(gold.len() as u64)}),
        json!({"name": "arrows", "kind": "number", "values": range(cave["arrows"].as_u64().unwrap())}),
        json!({"name": "outside", "kind": "category", "weight": 5, "values": booleans}),
    ];
    let things = |name: &str, n: usize| {
        (1..=n)
            .map(|k| json!({"name": format!("{name}_{k}"), "kind": "category", "weight": 0, "values": booleans}))
            .collect::<Vec<_>>()
    };
    attributes.extend(things("wumpus", wumpi.len()));
    attributes.extend(things("gold", gold.len()));

    // How far a wumpus is ahead, if it is in line.
    let ahead = |heading: &str, (wx, wy): (u64, u64)| match heading {
        "east" => (format!("y == {wy} && x < {wx}"), format!("{wx} - x")),
        "north" => (format!("x == {wx} && y < {wy}"), format!("{wy} - y")),
        "west" => (format!("y == {wy} && x > {wx}"), format!("x - {wx}")),
        _ => (format!("x == {wx} && y > {wy}"), format!("y - {wy}")),
    };
    let mut rules = Vec::new();
    for action in model["actions"].as_array().unwrap() {
        let action = action["name"].as_str().unwrap();
        let mut rule = |when: String, then: Value| {
            rules.push(json!({"action": action, "when": format!("!outside && {when}"), "then": then}));
        };
        match action {
            "forward" => {
                rule(format!("heading == 'east' && x + 1 < {width}"), json!({"x": "x + 1"}));
                rule(format!("heading == 'north' && y + 1 < {height}"), json!({"y": "y + 1"}));
                rule("heading == 'west' && x > 0".into(), json!({"x": "x - 1"}));
                rule("heading == 'south' && y > 0".into(), json!({"y": "y - 1"}));
            }
            "turn_left" => rule(
                "true".into(),
                json!({"heading": "heading == 'east' ? 'north' : heading == 'north' ? 'west' : heading == 'west' ? 'south' : 'east'"}),
            ),
            "turn_right" => rule(
                "true".into(),
                json!({"heading": "heading == 'east' ? 'south' : heading == 'south' ? 'west' : heading == 'west' ? 'north' : 'east'"}),
            ),
            "shoot" => {
                for heading in ["east", "north", "west", "south"] {
                    for (k, wumpus) in wumpi.iter().enumerate() {
                        let (in_line, distance) = ahead(heading, *wumpus);
                        let closer = wumpi.iter().enumerate().filter(|(j, _)| *j != k).map(|(j, other)| {
                            let (other_in_line, other_distance) = ahead(heading, *other);
                            let sign = if j < k { "<=" } else { "<" };
                            format!("!(wumpus_{} && {other_in_line} && {other_distance} {sign} {distance})", j + 1)
                        });
                        let closer = closer.collect::<Vec<_>>().join(" && ");
                        let closer = if closer.is_empty() { "true".to_owned() } else { closer };
                        rule(
                            format!(
                                "arrows > 0 && heading == '{heading}' && wumpus_{} && {in_line} && {closer}",
                                k + 1
                            ),
                            json!({"arrows": "arrows - 1", format!("wumpus_{}", k + 1): "false"}),
                        );
                    }
                }
                rule("arrows > 0".into(), json!({"arrows": "arrows - 1"}));
            }
            "grab" => {
                for (k, (gx, gy)) in gold.iter().enumerate() {
                    rule(
                        format!("gold_{} && [x, y] == [{gx}, {gy}]", k + 1),
                        json!({"gold": "gold + 1", format!("gold_{}", k + 1): "false"}),
                    );
                }
                rule("false".into(), json!({}));
            }
            _ => rule("x == home[0] && y == home[1]".into(), json!({"outside": "true"})),
        }
    }
    let alive = wumpi.iter().enumerate().map(|(k, (wx, wy))| format!("wumpus_{} && x == {wx} && y == {wy}", k + 1));
    let deadly: Vec<String> = std::iter::once("[x, y] in pits".to_owned()).chain(alive).collect();
    let mut start = json!({
        "x": cave["start"]["x"], "y": cave["start"]["y"], "heading": cave["start"]["heading"], "gold": 0,
        "arrows": cave["arrows"], "outside": false,
    });
    (1..=wumpi.len()).for_each(|k| start[format!("wumpus_{k}")] = true.into());
    (1..=gold.len()).for_each(|k| start[format!("gold_{k}")] = true.into());
    json!({
        "attributes": attributes, "actions": model["actions"],
        "dynamics": {
            "kind": "rules", "constants": {"pits": pits, "home": [cave["start"]["x"], cave["start"]["y"]]}, "start": start,
            "rules": rules, "unsafe": deadly.join(" || "),
        },
    })
}
