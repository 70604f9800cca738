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

#[test]
fn every_member_that_stands_twice_is_a_fault_with_its_place() {
    let text = r#"{"a": {"x": 1, "x": 1}, "b": [{"c/d": [], "y": {}, "c/d": null, "c\u002fd": 2}], "a": {"z": 1}}"#;
    let Err(ParseError::Faults(faults)) = parse(text.as_bytes()) else { panic!("it has faults") };
    let pointers: Vec<_> = faults.listed().iter().map(|fault| fault.pointer.as_str()).collect();
    assert_eq!(pointers, ["/a/x", "/b/0/c~1d", "/b/0/c~1d", "/a"]);
    assert!(faults.to_string().contains("stands twice"), "{faults}");
    // What is wrong with the text itself counts more.
    assert!(matches!(parse(br#"{"a": 1, "a": 2"#), Err(ParseError::Syntax { .. })));
    let Err(ParseError::Faults(faults)) = parse(br#"{"a": 1, "a": 1e999}"#) else { panic!("it has faults") };
    assert_eq!(faults.count(), 2, "{faults}");
}

#[test]
fn a_byte_order_mark_says_nothing() {
    assert_eq!(parse("\u{feff}{\"a\": [7.5, -1, \"\u{feff}\"]}".as_bytes()), Ok(json!({"a": [7.5, -1, "\u{feff}"]})));
    assert!(parse("\u{feff}\u{feff}7".as_bytes()).is_err());
}

#[test]
fn a_whole_number_may_have_a_point_or_an_exponent() {
    let read = |text: &str| {
        let (value, mut faults) = (parse(text.as_bytes()).unwrap(), Faults::default());
        let (integer, index) =
            (Place::root(&value).integer(0, 1000, &mut faults), Place::root(&value).index(9, "state", &mut faults));
        (integer, index, faults.count())
    };
    assert_eq!(read("8.0"), (Some(8), Some(8), 0));
    assert_eq!(read("0.8e1"), (Some(8), Some(8), 0));
    assert_eq!(read("-0.0"), (Some(0), Some(0), 0));
    assert_eq!(read("1e2"), (Some(100), None, 1));
    for text in ["8.5", "-1.0", "1e300", "1e-3"] {
        assert_eq!(read(text), (None, None, 2), "{text}");
    }
}
