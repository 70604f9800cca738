use std::io::Cursor;

use serde_json::{Value, json};

use super::*;
use etude_core::attribute::AttributeDocument;

/// `x` is a number, `heading` has labels, `door` is a category.
fn cells() -> Cells {
    let attributes: Vec<AttributeDocument> = serde_json::from_value(json!([
        {"name": "x", "kind": "number"},
        {"name": "heading", "kind": "cyclic", "labels": ["east", "1"]},
        {"name": "door", "kind": "category"},
    ]))
    .unwrap();
    Cells::told(&attributes)
}

fn open(path: &str, text: &[u8], columns: &[&str]) -> Result<Observations, CliError> {
    let columns: Vec<Column> = columns.iter().map(|column| column.parse().unwrap()).collect();
    Observations::read(Path::new(path), Box::new(Cursor::new(text.to_vec())), &columns, &cells())
}

/// The observations, each with what would be told of its `x`; the error after them, if there is one.
fn read(path: &str, text: &[u8], columns: &[&str]) -> (Vec<(Value, String)>, Option<String>) {
    let mut read = Vec::new();
    let mut observations = match open(path, text, columns) {
        Ok(observations) => observations,
        Err(error) => return (read, Some(error.to_string())),
    };
    loop {
        match observations.next() {
            Ok(Some(Observation { spot, state })) => read.push((state, spot.tell("/x", "wrong"))),
            Ok(None) => return (read, None),
            Err(error) => return (read, Some(error.to_string())),
        }
    }
}

fn states(path: &str, text: &str, columns: &[&str]) -> Value {
    let (read, error) = read(path, text.as_bytes(), columns);
    assert_eq!(error, None);
    read.into_iter().map(|(state, _)| state).collect()
}

fn error(path: &str, text: &[u8], columns: &[&str]) -> String {
    read(path, text, columns).1.unwrap()
}

#[test]
fn each_form_is_known_by_its_first_bytes_whatever_it_is_called() {
    let expected = json!([{"x": 1}, {"x": 2}]);
    for path in ["-", "seen", "seen.json", "seen.ndjson", "seen.jsonl", "seen.txt"] {
        for text in [
            r#"[{"x": 1}, {"x": 2}]"#,
            "\n [\n {\"x\": 1},\n {\"x\": 2}\n]\n",
            "{\"x\": 1}\n\n{\"x\": 2}",
            "\u{feff}{\"x\": 1}\r\n{\"x\": 2}\r\n",
            r#"{"demonstration": [{"x": 1}, {"x": 2}]}"#,
            "{\n \"demonstration\": [{\"x\": 1},\n {\"x\": 2}]\n}",
        ] {
            assert_eq!(states(path, text, &[]), expected, "{path}: {text:?}");
        }
    }
    for path in ["-", "seen", "seen.csv", "seen.CSV", "seen.tsv"] {
        for text in ["x\n1\n2\n", "\u{feff}x\r\n1\r\n\r\n2", "\n\"x\"\n\"1\"\n 2 \n"] {
            assert_eq!(states(path, text, &[]), expected, "{path}: {text:?}");
        }
    }
    assert_eq!(states("-", "[1, \"east\", null]\n[2, null, true]\n", &[]), json!([[1, "east", null], [2, null, true]]));
    assert_eq!(
        states("-", "[[1, \"east\", null],\n[2, null, true]]", &[]),
        json!([[1, "east", null], [2, null, true]])
    );
    assert_eq!(states("-", "", &[]), json!([]));
    assert_eq!(states("-", "x,door\n", &[]), json!([]));
}

#[test]
fn a_request_keeps_its_options() {
    let mut observations = open("-", br#"{"weights": {"x": 2}, "demonstration": [{}]}"#, &[]).unwrap();
    assert_eq!(Value::from(observations.take_request()), json!({"weights": {"x": 2}}));
}

#[test]
fn cells_are_what_their_attributes_are() {
    let table = "x;heading;door\n1,5;east;open\n-2.50;1;True\n1e3;nan;7\n;;7.0\nNaN;east;007x\n";
    assert_eq!(
        states("-", table, &[]),
        json!([
            {"x": "1,5", "heading": "east", "door": "open"},
            {"x": -2.5, "heading": "1", "door": true},
            {"x": 1e3, "heading": null, "door": 7},
            {"x": null, "heading": null, "door": 7},
            {"x": null, "heading": "east", "door": "007x"},
        ])
    );
    let quoted = "\"door\",x\n\"a, \"\"b\"\"\nc\",1\nd,2\n";
    assert_eq!(states("-", quoted, &[]), json!([{"x": 1, "door": "a, \"b\"\nc"}, {"x": 2, "door": "d"}]));
}

#[test]
fn a_number_in_a_table_keeps_all_its_digits() {
    let state = &states("-", "x\n9007199254740993\n", &[])[0];
    assert_eq!(state.to_string(), r#"{"x":9007199254740993}"#);
}

#[test]
fn strings_of_a_model_that_look_like_something_else_stay_strings() {
    let document = json!({
        "attributes": [{"name": "room", "kind": "category"}, {"name": "lit", "kind": "category"}],
        "actions": [],
        "dynamics": {"kind": "table", "states": [["1", true], ["true", 2]], "transitions": []},
    });
    let definition = etude_core::model::Definition::read(
        &document,
        etude_core::model::Limits::DEFAULT,
        &mut etude_core::interrupt::Uninterrupted,
    );
    let model = etude_core::model::Model::compile(
        &definition.unwrap(),
        etude_core::model::Limits::DEFAULT,
        &mut etude_core::interrupt::Uninterrupted,
    );
    let input = Box::new(Cursor::new(b"room,lit\n1,1\ntrue,true\n2,2\n".to_vec()));
    let mut observations = Observations::read(Path::new("-"), input, &[], &Cells::of(&model.unwrap())).unwrap();
    let mut next = || observations.next().unwrap().unwrap().state;
    assert_eq!(next(), json!({"room": "1", "lit": 1}));
    assert_eq!(next(), json!({"room": "true", "lit": true}));
    assert_eq!(next(), json!({"room": 2, "lit": 2}));
}

#[test]
fn columns_may_be_called_otherwise_and_be_in_other_units() {
    for (column, expected) in [
        ("x=lon", json!([{"x": 2}])),
        ("x = lon", json!([{"x": 2}])),
        ("x=lon*1000", json!([{"x": 2000.0}])),
        ("x=lon*1e-3", json!([{"x": 0.002}])),
        ("x=lon*-2", json!([{"x": -4.0}])),
        ("x=lon+0.5", json!([{"x": 2.5}])),
        ("x=lon-5", json!([{"x": -3.0}])),
        ("x=lon*10+-5", json!([{"x": 15.0}])),
        ("x=lon*10 - 1e-1", json!([{"x": 19.9}])),
    ] {
        assert_eq!(states("-", "lon\n2\n", &[column]), expected, "{column}");
        assert_eq!(states("-", "{\"lon\": 2}", &[column]), expected, "{column}");
    }
    // A column whose name looks like a sum.
    assert_eq!(states("-", "a-1\n2\n", &["x=a-1"]), json!([{"x": 2}]));
    // What two columns are called may change places.
    let swapped = json!([{"x": 2, "door": 1}]);
    assert_eq!(states("-", "x,door\n1,2\n", &["x=door", "door=x"]), swapped);
    assert_eq!(states("-", "{\"x\": 1, \"door\": 2}", &["x=door", "door=x"]), swapped);
    for wrong in ["x", "=lon", "x="] {
        assert!(wrong.parse::<Column>().unwrap_err().contains("ATTRIBUTE=COLUMN"), "{wrong}");
    }
}

#[test]
fn nan_is_not_observed_and_infinity_is_told_as_what_it_is() {
    assert_eq!(
        states("-", "{\"x\": NaN, \"door\": \"NaN \\\" NaN\"}", &[]),
        json!([{"x": null, "door": "NaN \" NaN"}])
    );
    assert_eq!(states("-", "[{\"x\":NaN}]", &[]), json!([{"x": null}]));
    let told = error("-", b"{\"x\": 1}\n{\"x\": -Infinity}", &[]);
    assert_eq!(told, "line 2 of the input: /x: expected a finite number, found one beyond the range of 64-bit floats");
}

#[test]
fn faults_are_told_with_file_row_and_column() {
    let spots = |path: &str, text: &str, columns: &[&str]| {
        read(path, text.as_bytes(), columns).0.into_iter().map(|(_, told)| told).collect::<Vec<_>>()
    };
    let table = "\nlon,door\n1,\"a\nb\"\n2,c\n";
    assert_eq!(
        spots("a.csv", table, &["x=lon"]),
        [r#"row 3 of a.csv, column "lon": wrong"#, r#"row 5 of a.csv, column "lon": wrong"#]
    );
    assert_eq!(spots("-", "\n{}\n\n{}", &[]), ["line 2 of the input: /x: wrong", "line 4 of the input: /x: wrong"]);
    assert_eq!(spots("a.json", "[{},\n{}]", &[])[1], "a.json: /1/x: wrong");
    assert_eq!(spots("a.json", "{\"demonstration\": [{}]}", &[]), ["a.json: /demonstration/0/x: wrong"]);

    for (path, text, columns, expected) in [
        ("a.csv", "x,door\n1,2\n3\n", &[][..], "row 3 of a.csv: 1 cells, where the header has 2"),
        ("a.csv", "x\n\"1\n2\n", &[], "row 2 of a.csv: a quoted cell has no end"),
        ("a.csv", "x,y,x\n", &[], "a.csv has two columns \"x\""),
        ("a.csv", "lat\n", &["x=lon"], "--column x=lon: a.csv has no column \"lon\"; it has \"lat\""),
        ("a.csv", "x\n", &["z=x"], "--column z=x: unknown attribute \"z\"; the model has \"x\", \"heading\", \"door\""),
        ("a.csv", "x,d\n", &["door=d*2"], "--column door=d*2: \"door\" is no number that could be scaled"),
        ("-", "{\"x\": 1}\n{\"x\"\n", &[], "line 2 of the input: not JSON at column 4: EOF while parsing an object"),
        ("-", "[{\"x\": 1},\n}]", &[], "the input: not JSON at line 2, column 1: expected value"),
        ("a.json", "{\n\"demonstration\": 7}", &[], "a.json: /demonstration: expected an array of observations"),
        ("a.json", "\"x\"", &[], "a.json: expected an array of observations"),
    ] {
        assert_eq!(error(path, text.as_bytes(), columns), expected);
    }
    assert_eq!(error("a.csv", b"x,door\n1,\xe4\n", &[]), "row 2 of a.csv: is not UTF-8");
    assert_eq!(error("-", b"\xff\xfex\0\n\0", &[]), "the input is UTF-16: save it as UTF-8");
    let told = error("-", b"hello\n1\n", &[]);
    assert!(told.contains(r#"the model, which are "x", "heading", "door"; found "hello""#), "{told}");
}
