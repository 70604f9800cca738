//! Whatever way a model is laid out, the same is read.

use std::io::{self, Read};

use proptest::prelude::*;
use serde_json::{Value, json};

use super::{Format, MAX_LINE_BYTES, ReadError, Reader};
use crate::document::{Fault, ParseError};
use crate::interrupt::{Meter, Signal, Uninterrupted};
use crate::model::{Definition, Limits};

fn parse(text: &str, format: Format) -> Result<Definition, ReadError> {
    Definition::parse(text.as_bytes(), format, Limits::DEFAULT, &mut Uninterrupted)
}

/// The canonical text, or all faults, however a model was read.
fn outcome(read: Result<Definition, ReadError>) -> Result<String, Vec<Fault>> {
    match read {
        Ok(definition) => Ok(definition.text()),
        Err(ReadError::Faults(faults)) => Err(faults.listed().to_vec()),
        Err(error) => panic!("{error}"),
    }
}

/// Gives a byte at a time, as the worst of networks would.
struct Trickle<'t>(&'t [u8]);

impl Read for Trickle<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n_read = self.0.len().min(buffer.len()).min(1);
        let (read, rest) = self.0.split_at(n_read);
        buffer[..n_read].copy_from_slice(read);
        self.0 = rest;
        Ok(n_read)
    }
}

/// Something that does not belong where it stands, more often than not.
fn odd() -> impl Strategy<Value = Value> {
    prop::sample::select(vec![
        json!(null),
        json!(true),
        json!(-1),
        json!(1.5),
        json!(7),
        json!(4_294_967_295_u32),
        json!(u64::MAX),
        json!("up"),
        json!("x".repeat(2000)),
        json!([]),
        json!([[0], 1]),
        json!({"a": [1]}),
    ])
}

fn or_odd<T: Into<Value>>(usual: impl Strategy<Value = T>, weight: u32) -> impl Strategy<Value = Value> {
    prop_oneof![30 => usual.prop_map(Into::into), weight => odd()]
}

fn array(items: impl Into<Vec<Value>>) -> Value {
    Value::Array(items.into())
}

/// Rows of a number, a label and a category each; most of them, if not all.
fn states(weight: u32) -> impl Strategy<Value = Vec<Value>> {
    let number =
        or_odd(prop::sample::select(vec![json!(0), json!(0.0), json!(-0.0), json!(1), json!(1.0), json!(2.5)]), weight);
    let label = or_odd(prop::sample::select(vec!["east", "west"]), weight);
    let category = or_odd(prop::sample::select(vec![json!("a"), json!(1), json!(true)]), weight);
    let row = (number, label, category).prop_map(|(number, label, category)| array([number, label, category]));
    let short = prop::collection::vec(odd(), 0..6).prop_map(array);
    let row = prop_oneof![30 => row, weight => short, weight => odd()];
    prop::collection::vec(row, 1..12)
}

fn transitions(weight: u32) -> impl Strategy<Value = Vec<Value>> {
    let index = || or_odd(0u32..12, weight);
    let action = or_odd(prop::sample::select(vec![json!("on"), json!("back"), json!(0), json!(1)]), weight);
    let item = (index(), action, index()).prop_map(|(from, action, to)| array([from, action, to]));
    prop::collection::vec(prop_oneof![30 => item, weight => odd()], 0..12)
}

/// A model's members, those of its dynamics, and an order of each.
#[derive(Clone, Debug)]
struct Layout {
    members: Vec<(&'static str, Value)>,
    dynamics: Vec<(&'static str, Value)>,
}

fn layout(weight: u32) -> impl Strategy<Value = Layout> {
    let attributes = json!([
        {"name": "x", "kind": "number"}, {"name": "heading", "kind": "cyclic", "labels": ["east", "west"]},
        {"name": "mood", "kind": "category"},
    ]);
    let members = vec![
        ("attributes", attributes),
        ("actions", json!([{"name": "on"}, {"name": "back"}])),
        ("dynamics", json!(0)),
    ];
    (states(weight), transitions(weight), Just(members).prop_shuffle()).prop_flat_map(
        |(states, transitions, members)| {
            let dynamics = vec![
                ("kind", json!("table")),
                ("states", states.into()),
                ("transitions", transitions.into()),
                ("unsafe", json!([])),
                ("start", json!(0)),
            ];
            Just(dynamics).prop_shuffle().prop_map(move |dynamics| Layout { members: members.clone(), dynamics })
        },
    )
}

impl Layout {
    fn object(members: &[(&str, String)]) -> String {
        let members: Vec<String> = members.iter().map(|(name, member)| format!("\"{name}\": {member}")).collect();
        format!("{{{}}}", members.join(", "))
    }

    /// The text, with these members of the dynamics in their order.
    fn text(&self, is_member: impl Fn(&str) -> bool) -> String {
        let dynamics: Vec<_> = self.dynamics.iter().filter(|(name, _)| is_member(name)).cloned().collect();
        let dynamics: Vec<_> = dynamics.iter().map(|(name, member)| (*name, member.to_string())).collect();
        let members = self.members.iter().map(|(name, member)| match *name {
            "dynamics" => ("dynamics", Self::object(&dynamics)),
            name => (name, member.to_string()),
        });
        Self::object(&members.collect::<Vec<_>>())
    }

    fn document(&self) -> Value {
        serde_json::from_str(&self.text(|_| true)).unwrap()
    }

    fn list(&self, name: &str) -> &[Value] {
        let list = self.dynamics.iter().find(|(known, _)| *known == name);
        list.and_then(|(_, list)| list.as_array()).unwrap()
    }

    /// As lines: the lists in chunks of `n`, those of one in between those of the other.
    fn lines(&self, n: usize) -> (String, Vec<(&'static str, usize)>) {
        let mut lines = vec![self.text(|name| !["states", "transitions"].contains(&name))];
        // What each line begins with.
        let mut firsts = vec![("", 0)];
        for name in ["transitions", "states"].into_iter().filter(|name| self.list(name).is_empty()) {
            lines.push(json!({name: []}).to_string());
            firsts.push((name, 0));
        }
        let mut chunks = ["transitions", "states"].map(|name| self.list(name).chunks(n).enumerate());
        loop {
            let before = lines.len();
            for (name, chunks) in ["transitions", "states"].into_iter().zip(&mut chunks) {
                if let Some((k, chunk)) = chunks.next() {
                    lines.push(json!({name: chunk}).to_string());
                    firsts.push((name, k * n));
                }
            }
            if lines.len() == before {
                return (lines.join("\n"), firsts);
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn members_may_stand_in_any_order_and_come_in_any_way(
        layout in prop_oneof![layout(0), layout(1), layout(8)],
    ) {
        // Members of a value in memory are in the order of their names.
        let document = layout.document();
        let expected = outcome(Definition::read(&document, Limits::DEFAULT, &mut Uninterrupted).map_err(|error| match error {
            crate::model::CompileError::Faults(faults) => faults.into(),
            crate::model::CompileError::Cancelled(cancelled) => cancelled.into(),
            crate::model::CompileError::OutOfTime => crate::model::ReadError::OutOfTime,
        }));
        let text = layout.text(|_| true);
        prop_assert_eq!(&outcome(parse(&text, Format::Json)), &expected);
        let trickle = io::BufReader::with_capacity(3, Trickle(text.as_bytes()));
        let read = Definition::parse_from(trickle, Format::Json, Limits::DEFAULT, &mut Uninterrupted);
        prop_assert_eq!(&outcome(read), &expected);
        if let Ok(canonical) = &expected {
            prop_assert_eq!(&outcome(parse(canonical, Format::Json)), &expected);
        }
    }

    #[test]
    fn lines_give_the_same_as_one_text_and_faults_lead_to_the_same_values(
        layout in prop_oneof![layout(0), layout(1), layout(8)],
        n in 1usize..5,
    ) {
        let expected = outcome(parse(&layout.text(|_| true), Format::Json));
        let (lines, firsts) = layout.lines(n);
        let found = outcome(parse(&lines, Format::Ndjson)).map_err(|faults| {
            // Where they would be in one text.
            let in_one_text = faults.into_iter().map(|fault| {
                let line = usize::try_from(fault.line.unwrap()).unwrap();
                let (list, first) = firsts[line - 1];
                let pointer = match fault.pointer.strip_prefix(&format!("/{list}/")) {
                    Some(rest) if line > 1 => {
                        let (item, rest) = rest.split_once('/').map_or((rest, String::new()), |(item, rest)| (item, format!("/{rest}")));
                        format!("/dynamics/{list}/{}{rest}", first + item.parse::<usize>().unwrap())
                    }
                    _ => fault.pointer,
                };
                Fault { line: None, pointer, ..fault }
            });
            in_one_text.collect::<Vec<_>>()
        });
        prop_assert_eq!(found, expected);
    }
}

#[test]
fn every_member_that_stands_twice_is_a_fault_with_its_place() {
    let text = r#"{
        "attributes": [{"name": "x", "kind": "number", "weight": 1, "weight": 2}], "actions": [{"name": "on"}],
        "dynamics": {"kind": "table", "states": [[7]], "transitions": [[0, "on", 1]], "states": [[0], [1]], "start": 0, "start": 1},
        "actions": []
    }"#;
    let faults = outcome(parse(text, Format::Json)).unwrap_err();
    let twice = faults.iter().filter(|fault| fault.detail.contains("twice")).map(|fault| fault.pointer.as_str());
    let places = ["/attributes/0/weight", "/dynamics/states", "/dynamics/start", "/actions"];
    assert_eq!(twice.collect::<Vec<_>>(), places);
    let read = Definition::parse_from(text.as_bytes(), Format::Json, Limits::DEFAULT, &mut Uninterrupted);
    assert_eq!(outcome(read), Err(faults));
    let line = text.replace('\n', " ");
    let faults = outcome(parse(&line, Format::Ndjson)).unwrap_err();
    assert!(places.iter().all(|place| faults.iter().any(|fault| (fault.line, &*fault.pointer) == (Some(1), *place))));
}

#[test]
fn a_text_or_a_line_may_begin_with_a_byte_order_mark() {
    let model = r#"{"attributes": [{"name": "x", "kind": "number"}], "actions": [], "dynamics": {"kind": "table", "states": [[0]], "transitions": []}}"#;
    let expected = outcome(parse(model, Format::Json));
    assert!(expected.is_ok());
    let marked = format!("\u{feff}{model}");
    for format in [Format::Json, Format::Ndjson] {
        assert_eq!(outcome(parse(&marked, format)), expected);
        let trickle = io::BufReader::with_capacity(1, Trickle(marked.as_bytes()));
        assert_eq!(outcome(Definition::parse_from(trickle, format, Limits::DEFAULT, &mut Uninterrupted)), expected);
    }
    let lines = format!("{model}\n\u{feff}{{\"states\": [[1]]}}\n");
    assert!(parse(&lines, Format::Ndjson).is_ok());
    for text in [&b"\xef"[..], b"\xef\xbb{}"] {
        let read = Definition::parse_from(text, Format::Json, Limits::DEFAULT, &mut Uninterrupted);
        assert!(matches!(read, Err(ReadError::Parse(ParseError::Syntax { line: 1, .. }))), "{read:?}");
    }
}

#[test]
fn a_list_that_stands_twice_on_a_later_line_is_a_fault() {
    let model = r#"{"attributes": [{"name": "x", "kind": "number"}], "actions": [], "dynamics": {"kind": "table"}}"#;
    let read = |chunk: &str| outcome(parse(&format!("{model}\n{chunk}\n"), Format::Ndjson));
    assert!(read(r#"{"states": [[0], [1]], "transitions": []}"#).is_ok());
    let faults = read(r#"{"states": [[0], [1]], "transitions": [], "states": [[2]]}"#).unwrap_err();
    let [fault] = &faults[..] else { panic!("{faults:?}") };
    assert_eq!((fault.line, fault.pointer.as_str()), (Some(2), "/states"));
}

#[test]
fn what_is_wrong_is_said_as_it_always_was() {
    let text = r#"{
        "attributes": [{"name": "x", "kind": "number"}, {"name": "c", "kind": "category"}],
        "actions": [{"name": "on"}, {"name": "back"}],
        "dynamics": {
            "kind": "table",
            "states": [[0, "a"], "row", {"x": 0}, [1], [[1, 2], {}], ["1", 1.5], [18446744073709551615, null], [-0.0, false]],
            "transitions": [[0, "on", 1], [0, 0, 2], [8, "up", 4294967296], [1, 2, 0], [1.0, [1], -1], [1, 0], 3, [7, 1, 7]]
        }
    }"#;
    let Err(faults) = outcome(parse(text, Format::Json)) else { panic!("it has faults") };
    let told: Vec<_> = faults.iter().map(|fault| format!("{}: {}", fault.pointer, fault.detail)).collect();
    assert_eq!(
        told,
        [
            "/dynamics/states/1: expected an array, found \"row\"",
            "/dynamics/states/2: expected an array, found an object",
            "/dynamics/states/3: expected 2 values, one per attribute, found 1",
            "/dynamics/states/4/0: expected a number, found an array of 2",
            "/dynamics/states/4/1: expected a string, an integer or a boolean, found an object",
            "/dynamics/states/5/0: expected a number, found \"1\"",
            "/dynamics/states/5/1: expected a string, an integer or a boolean, found 1.5",
            "/dynamics/states/6/0: found 18446744073709551615, which no number holds exactly (they are 64-bit floats, whole up \
             to 2^53): make the attribute a category",
            "/dynamics/states/6/1: expected a string, an integer or a boolean, found null",
            "/dynamics/transitions/2/0: there is no state 8: there are 8, counted from 0",
            "/dynamics/transitions/2/1: expected one of the actions \"on\", \"back\", found \"up\"",
            "/dynamics/transitions/2/2: expected the index of a state, found 4294967296",
            "/dynamics/transitions/3/1: there is no action 2: there are 2, counted from 0",
            "/dynamics/transitions/4/1: expected the index of an action, found an array of 1",
            "/dynamics/transitions/4/2: expected the index of a state, found -1",
            "/dynamics/transitions/5: expected [from, action, to, probability, cost], of which the last two may be left out, \
             found an array of 2",
            "/dynamics/transitions/6: expected an array, found 3",
            "/dynamics/transitions/1: state 0 has a transition by this action already: transition 0; an action with several \
             outcomes needs their probabilities: [from, action, to, probability]",
        ]
    );
}

#[test]
fn faults_beyond_those_that_are_listed_are_counted_and_not_kept() {
    let rows = vec![json!("no row"); 3000];
    let transitions = vec![json!([0, "fly"]); 4000];
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on"}],
        "dynamics": {"kind": "table", "states": rows, "transitions": transitions},
    });
    let Err(ReadError::Faults(faults)) = parse(&model.to_string(), Format::Json) else { panic!("it has faults") };
    assert_eq!((faults.listed().len(), faults.count()), (1000, 7000));
    assert_eq!(faults.listed()[999].pointer, "/dynamics/states/999");
}

#[test]
fn a_line_and_what_is_kept_of_a_model_have_limits() {
    let long = format!("{{\"actions\": [{}]}}", " ".repeat(MAX_LINE_BYTES));
    let read = parse(&long, Format::Ndjson);
    assert!(matches!(&read, Err(ReadError::TooLarge(detail)) if detail.starts_with("line 1 ")), "{read:?}");
    // Whatever is not a list of states or transitions is kept while it is read.
    let mut never = Uninterrupted;
    let mut meter = Meter::new(&mut never, 1);
    let reader = Reader { max_held_bytes: 10_000, ..Reader::new(Limits::DEFAULT, &mut meter) };
    let many = format!("{{\"attributes\": [{}0]}}", "0,".repeat(1000));
    assert!(matches!(reader.read_text(many.as_bytes(), Format::Json), Err(ReadError::TooLarge(_))));
    let lists = json!({"dynamics": {"states": vec![json!([0]); 1000], "transitions": vec![json!([0, 0, 0]); 1000]}});
    let reader = Reader { max_held_bytes: 10_000, ..Reader::new(Limits::DEFAULT, &mut meter) };
    assert!(reader.read_text(lists.to_string().as_bytes(), Format::Json).is_ok());
}

/// Fails.
struct Broken;

impl Read for Broken {
    fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
        Err(io::Error::other("gone"))
    }
}

#[test]
fn a_text_that_ends_early_is_no_model() {
    let text = json!({"attributes": [], "actions": [], "dynamics": {"kind": "table", "states": [[0]]}}).to_string();
    for end in [0, 1, text.len() / 2, text.len() - 1] {
        let cut = parse(&text[..end], Format::Json);
        assert!(matches!(cut, Err(ReadError::Parse(ParseError::Syntax { line: 1, .. }))), "{cut:?}");
    }
    for format in [Format::Json, Format::Ndjson] {
        let reader = io::BufReader::new(text.as_bytes()[..9].chain(Broken));
        let read = Definition::parse_from(reader, format, Limits::DEFAULT, &mut Uninterrupted);
        assert!(matches!(&read, Err(ReadError::Read(error)) if error.to_string() == "gone"), "{read:?}");
    }
}

#[test]
fn a_text_of_blanks_or_of_one_string_is_interrupted_while_it_is_read() {
    let n_bytes = 16 << 20;
    for (head, byte) in [("", b' '), ("{\"", b'a'), ("{\"attributes\": ", b' ')] {
        for format in [Format::Json, Format::Ndjson] {
            for signal in [Signal::Cancel, Signal::Finish] {
                let text = io::Read::chain(head.as_bytes(), io::Read::take(io::repeat(byte), n_bytes));
                let mut n_left = 10;
                let mut interrupt = || {
                    n_left -= 1;
                    if n_left == 0 { signal } else { Signal::Continue }
                };
                let text = io::BufReader::new(text);
                let read = Definition::parse_from(text, format, Limits::DEFAULT, &mut interrupt);
                let is_told = match signal {
                    Signal::Cancel => matches!(read, Err(ReadError::Cancelled(_))),
                    _ => matches!(read, Err(ReadError::OutOfTime)),
                };
                assert!(is_told, "{read:?}");
            }
        }
    }
}
