use serde_json::json;

use super::*;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{Definition, Limits};

const MODEL: &str = include_str!("../../../examples/figure-4/model.json");
const DEMONSTRATION: &str = include_str!("../../../examples/figure-4/demonstration.json");

fn mapper() -> Arc<Mapper> {
    mapper_of(&serde_json::from_str(MODEL).unwrap())
}

fn mapper_of(model: &Value) -> Arc<Mapper> {
    let definition = Definition::read(model, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
    Arc::new(Mapper::new(model, &mut Uninterrupted).unwrap())
}

/// The batch in `text`, if nothing is wrong with the batch itself.
fn read(text: &str, mapper: &Arc<Mapper>, memory: &Memory) -> Result<Option<Batch>, ServiceError> {
    let sent = SentRequest::read(RequestKind::Batch, &Bytes::from(text.to_owned()), memory)?;
    let Some(sent) = sent else { return Ok(None) };
    let model = sent.rest["model"].as_str().unwrap_or_default().to_owned();
    let names = Names { model, learner: None, deadline: None, is_stored: true, own_faults: Faults::default() };
    let named = Named { learner: None, model_hash: "hash".to_owned(), mapper: Arc::clone(mapper) };
    Batch::read(&sent, &names, named, (memory.clone(), Clock::system(), Ids::random()))
}

/// What comes of the items, but for ids and times.
fn follow(text: &str, mapper: &Arc<Mapper>) -> Option<Vec<Result<Value, String>>> {
    let batch = read(text, mapper, &Memory::with_room(1 << 30)).unwrap()?;
    let mut outcomes = Vec::new();
    loop {
        let slice = batch.run_slice(&mut Uninterrupted).unwrap();
        if slice.is_empty() {
            return Some(outcomes);
        }
        outcomes.extend(slice.into_iter().map(|(_, outcome)| match outcome {
            Ok(Searched { policy, .. }) => {
                let mut policy: Value = serde_json::from_str(&policy).unwrap();
                policy["id"] = Value::Null;
                policy["search"]["elapsed_us"] = Value::Null;
                Ok(policy)
            }
            Err(error) => Err(format!("{error:?}")),
        }));
    }
}

#[test]
fn what_comes_of_an_item_does_not_depend_on_the_others_or_on_the_order_of_members() {
    let mapper = mapper();
    let demonstration: Value = serde_json::from_str(DEMONSTRATION).unwrap();
    let good = json!({"demonstration": demonstration});
    let with = |name: &str, value: Value| {
        let mut item = good.clone();
        item[name] = value;
        item
    };
    let items = [
        good.clone(),
        with("weights", json!({"gold": 3, "x": 0})),
        with("weights", json!({"gold": -1, "mood": 1})),
        with("start", json!(7)),
        with("start", json!(100_000)),
        with("max_expansions", json!(5)),
        with("heuristic", json!("paper")),
        with("heuristic", json!("magic")),
        with("lookahead", json!(2)),
        with("lookahead", Value::Null),
        with("model", json!("other")),
        json!({"demonstration": [demonstration[0]]}),
        json!({"demonstration": [{"speed": 1}]}),
        json!({}),
        json!(7),
    ];
    for options in [r#""deadline_ms": null"#, r#""weights": {"x": 2}, "start": 3, "heuristic": "none""#] {
        let all = json!(items);
        let model_first = format!(r#"{{"model": "figure-4", {options}, "items": {all}}}"#);
        let items_first = format!(r#"{{"items": {all}, {options}, "model": "figure-4"}}"#);
        let together = follow(&model_first, &mapper).unwrap();
        assert_eq!(together.len(), items.len());
        assert_eq!(together.iter().filter(|outcome| outcome.is_err()).count(), 7);
        assert_eq!(follow(&items_first, &mapper), Some(together.clone()));
        for (item, outcome) in items.iter().zip(&together) {
            let alone = follow(&format!(r#"{{"model": "figure-4", {options}, "items": [{item}]}}"#), &mapper);
            let at_its_place = |error: &String| error.replace("/items/0", "");
            let [alone] = <[_; 1]>::try_from(alone.unwrap()).unwrap();
            match (&alone, outcome) {
                (Ok(alone), Ok(outcome)) => assert_eq!(alone, outcome, "{item}"),
                (Err(alone), Err(outcome)) => {
                    let n = items.iter().position(|other| other == item).unwrap();
                    assert_eq!(at_its_place(alone), outcome.replace(&format!("/items/{n}"), ""), "{item}");
                }
                _ => panic!("{item}: {alone:?} is not {outcome:?}"),
            }
        }
    }
}

#[test]
fn a_batch_with_something_wrong_is_not_followed() {
    let mapper = mapper();
    let good = format!(r#"{{"demonstration": {DEMONSTRATION}}}"#);
    for (items, options) in [
        (format!("[{good}]"), r#""weights": {"mood": 1}, "#),
        (format!("[{good}]"), r#""speed": 1, "#),
        (format!("[{good}]"), r#""lookahead": 0, "#),
        (format!(r#"[{{"demonstration": [{{"x": 1e999}}]}}, {good}]"#), ""),
        ("[]".to_owned(), ""),
        ("{}".to_owned(), ""),
    ] {
        assert_eq!(follow(&format!(r#"{{{options}"items": {items}, "model": "figure-4"}}"#), &mapper), None);
    }
}

#[test]
fn a_batch_of_too_many_items_or_observations_is_not_read_to_its_end() {
    let attribute = |n: usize| json!({"name": format!("{n:0>64}"), "kind": "number"});
    let mapper = mapper_of(&json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    }));
    let memory = Memory::with_room(1 << 30);
    let is_read = |lengths: &[usize]| {
        let items = lengths.iter().map(|len| format!(r#"{{"demonstration": [{}]}}"#, vec!["{}"; *len].join(",")));
        let items = items.collect::<Vec<_>>().join(",");
        read(&format!(r#"{{"model": "wide", "items": [{items}]}}"#), &mapper, &memory).unwrap().is_some()
    };
    let most = Policy::max_observations(mapper.model());
    assert!((100..Demonstration::MAX_OBSERVATIONS).contains(&most));
    assert!(is_read(&[most]) && is_read(&[most - 100, 99, 1]));
    assert!(!is_read(&[most + 1]) && !is_read(&[most - 100, 99, 1, 1]));
    assert!(is_read(&vec![0; MAX_BATCH_ITEMS]) && !is_read(&vec![0; MAX_BATCH_ITEMS + 1]));
}

#[test]
fn the_items_of_a_batch_hold_their_memory_and_are_not_read_without() {
    let attribute = |n: usize| json!({"name": format!("{n}"), "kind": "number"});
    let mapper = mapper_of(&json!({
        "attributes": (0..256).map(attribute).collect::<Vec<_>>(), "actions": [],
        "dynamics": {"kind": "table", "states": [vec![0; 256]], "transitions": []},
    }));
    let items = vec![format!(r#"{{"demonstration": [{}]}}"#, vec!["{}"; 100].join(",")); 100].join(",");
    let text = format!(r#"{{"model": "wide", "items": [{items}]}}"#);
    let memory = Memory::with_room(1 << 30);
    let batch = read(&text, &mapper, &memory).unwrap();
    let taken = (1 << 30) - memory.free();
    // 30 kB of text.
    let values = (100 * 100 * 256 * size_of::<Option<etude_core::attribute::Value>>()) as u64;
    assert!((values..values * 5 / 4).contains(&taken), "{taken} for {values}");
    drop(batch);
    assert_eq!(memory.free(), 1 << 30);
    let read_one_by_one = read(&text, &mapper, &Memory::with_room(values)).unwrap().unwrap();
    assert!(read_one_by_one.waiting.into_inner().unwrap().all(|(_, item)| item.read.is_none()));
}

#[test]
fn what_items_say_besides_their_demonstrations_is_counted() {
    let item = r#"{"demonstration": [{}], "weights": {"a": {"": {"": {"": {"": 0}}}}}}"#;
    let text = format!(r#"{{"model": "a", "items": [{}]}}"#, vec![item; 5000].join(","));
    let memory = Memory::with_room(1 << 30);
    let batch = read(&text, &mapper(), &memory).unwrap();
    assert!(batch.is_some() && (1 << 30) - memory.free() > 5000 * 6 * 600, "{}", memory.free());
}

#[test]
fn what_is_wrong_with_items_takes_memory_too() {
    let mapper = mapper();
    // Each of another kind: what is wrong with all observations alike is told once.
    let wrong: Vec<String> = (0..500).map(|n| format!(r#"{{"{n}": 9}}"#)).collect();
    let item = format!(r#"{{"demonstration": [{}]}}"#, wrong.join(","));
    let text = format!(r#"{{"model": "figure-4", "items": [{}]}}"#, vec![item.as_str(); 100].join(","));
    let told = |room: u64| {
        let memory = Memory::with_room(room);
        let batch = read(&text, &mapper, &Memory::with_room(1 << 30)).unwrap().unwrap();
        let batch = Batch { memory: memory.clone(), ..batch };
        let mut n_told = 0;
        loop {
            let slice = batch.run_slice(&mut Uninterrupted).unwrap();
            if slice.is_empty() {
                return (n_told, room - memory.free());
            }
            n_told += slice.iter().filter(|(_, outcome)| matches!(outcome, Err(ServiceError::Faults(_)))).count();
        }
    };
    let (n_told, taken) = told(1 << 30);
    assert!(n_told == 100 && taken > 100 * 500 * 200, "{n_told}, {taken}");
    let (n_told, taken) = told(taken / 2);
    assert!((10..60).contains(&n_told), "{n_told}, {taken}");
}
