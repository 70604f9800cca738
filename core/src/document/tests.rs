use serde_json::json;

use super::*;

#[test]
fn faults_carry_escaped_pointers_in_reading_order() {
    let value = json!({"a/b": [1, "x"], "c~": true});
    let mut faults = Faults::default();
    let root = Place::root(&value);
    let object = root.object(&["a/b"], &mut faults).unwrap();
    let items = object.required("a/b", &mut faults).unwrap();
    for (n, item) in items.array(&mut faults).unwrap().iter().enumerate() {
        items.item(n, item).number(Range::Finite, &mut faults);
    }
    object.required("gone", &mut faults);
    let pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.as_str()).collect();
    assert_eq!(pointers, ["/c~0", "/a~1b/1", "/gone"]);
}

#[test]
fn a_number_beyond_floats_is_a_fault_with_its_place() {
    let error = parse(br#"{"a": [0, 1e999]}"#).unwrap_err();
    let ParseError::Faults(faults) = error else { panic!("{error:?}") };
    assert_eq!(faults.listed()[0].pointer, "/a/1");
}

#[test]
fn nan_is_not_json() {
    let error = parse(b"{\n\"a\": NaN}").unwrap_err();
    assert!(matches!(error, ParseError::Syntax { line: 2, .. }), "{error:?}");
}

#[test]
fn the_list_of_faults_is_bounded_and_says_so() {
    let mut faults = Faults::default();
    for _ in 0..Faults::MAX_LISTED + 5 {
        faults.note_at(&Path::Root, "no");
    }
    assert_eq!((faults.listed().len(), faults.count()), (Faults::MAX_LISTED, Faults::MAX_LISTED + 5));
    assert!(faults.to_string().ends_with("and 5 more"));
}

#[test]
fn what_a_fault_repeats_of_a_document_is_cut() {
    let long = "\u{e9}".repeat(1_000_000);
    assert_eq!(Quoted(&long).to_string(), format!("\"{}\"..", "\u{e9}".repeat(60)));
    assert_eq!(Quoted("a\"b").to_string(), r#""a\"b""#);
    let names: Vec<String> = (0..60_000).map(|n| format!("{n}{long}")).take(12).collect();
    let known = list_known(&names);
    assert!(known.starts_with("\"0") && known.ends_with(", ..") && known.len() < 2000, "{known}");
    assert_eq!(list_known(["a", "b"]), r#""a", "b""#);
}

#[test]
fn an_index_of_an_action_is_asked_for_in_english() {
    let mut faults = Faults::default();
    Place::root(&json!("x")).index(3, "action", &mut faults);
    assert_eq!(faults.listed()[0].detail, "expected the index of an action, found \"x\"");
}
