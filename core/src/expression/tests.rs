use cel::{Context, Program, Value};
use proptest::prelude::*;

use super::*;

/// Names, and values of them, of all types.
fn variables() -> Vec<(&'static str, Type, Datum<'static>)> {
    let ints = Datum::list(vec![Datum::Int(3), Datum::Int(-1), Datum::Int(0)]);
    let texts = Datum::list(vec![Datum::text("a"), Datum::text("open")]);
    let list_of = |item| Type::List(Box::new(item));
    vec![
        ("i", Type::Int, Datum::Int(3)),
        ("j", Type::Int, Datum::Int(-2)),
        ("zero", Type::Int, Datum::Int(0)),
        ("huge", Type::Int, Datum::Int(i64::MAX)),
        ("d", Type::Double, Datum::Double(2.5)),
        ("e", Type::Double, Datum::Double(-0.5)),
        ("t", Type::Bool, Datum::Bool(true)),
        ("f", Type::Bool, Datum::Bool(false)),
        ("s", Type::Text, Datum::text("open")),
        ("u", Type::Text, Datum::text("shut")),
        ("ints", list_of(Type::Int), ints),
        ("texts", list_of(Type::Text), texts),
    ]
}

/// The value as the interpreter of the crate has it.
fn as_value(datum: &Datum<'_>) -> Value {
    match datum {
        Datum::Null => Value::Null,
        Datum::Int(number) => Value::Int(*number),
        Datum::Double(number) => Value::Float(*number),
        Datum::Bool(flag) => Value::Bool(*flag),
        Datum::Text(text) => Value::String(text.to_string().into()),
        Datum::List(list) => Value::List(list.iter().map(as_value).collect::<Vec<_>>().into()),
    }
}

fn read(text: &str, scope: &Scope) -> Result<Expression, Vec<String>> {
    read_all(&[text], scope, &mut Vec::new()).unwrap().remove(0)
}

/// Expressions that mostly have the types that are needed.
fn drawn() -> impl Strategy<Value = String> {
    let name = |names: &'static [&'static str]| prop::sample::select(names).prop_map(str::to_owned);
    let leaf = prop_oneof![
        4 => name(&["i", "j", "zero", "1", "7", "huge"]).prop_map(|text| (0, text)),
        3 => name(&["d", "e", "0.5", "2.0"]).prop_map(|text| (1, text)),
        3 => name(&["t", "f", "true"]).prop_map(|text| (2, text)),
        2 => name(&["s", "u", "'open'", "''"]).prop_map(|text| (3, text)),
        2 => name(&["ints", "[1, 2, 3]", "[i, j]"]).prop_map(|text| (4, text)),
    ];
    let tree = leaf.prop_recursive(4, 24, 3, |inner| {
        let any = (inner.clone(), inner.clone(), inner.clone(), 0usize..64);
        any.prop_map(|((kind, a), (other, b), (_, c), n)| {
            let of = |texts: &[(i32, String)]| texts[n % texts.len()].clone();
            match (kind, other) {
                (0 | 1, 0 | 1) => of(&[
                    (kind, format!("({a} + {b})")),
                    (kind, format!("({a} - {b})")),
                    (kind, format!("({a} * {b})")),
                    (kind, format!("({a} / {b})")),
                    (kind, format!("({a} % {b})")),
                    (2, format!("({a} < {b})")),
                    (2, format!("({a} >= {b})")),
                    (2, format!("({a} == {b})")),
                    (2, format!("({a} != {b})")),
                    (kind, format!("-({a})")),
                    (1, format!("double({a})")),
                    (0, format!("int({a})")),
                    (2, format!("({a} in [{b}, {a}])")),
                    (3, format!("string({a} > {b})")),
                ]),
                (2, 2) => of(&[
                    (2, format!("({a} && {b})")),
                    (2, format!("({a} || {b})")),
                    (2, format!("!({a})")),
                    (2, format!("({a} == {b})")),
                ]),
                (2, kind) => (kind, format!("({a} ? {b} : {b})")),
                (3, 3) => of(&[
                    (3, format!("({a} + {b})")),
                    (2, format!("({a} < {b})")),
                    (2, format!("{a}.startsWith({b})")),
                    (2, format!("{a}.contains({b})")),
                    (2, format!("{a}.endsWith({b})")),
                    (0, format!("size({a})")),
                    (2, format!("{a} in texts")),
                ]),
                (4, _) => of(&[
                    (0, format!("{a}[{b}]")),
                    (0, format!("size({a})")),
                    (2, format!("{a}.exists(v, v > 0)")),
                    (2, format!("{a}.all(v, v != i)")),
                    (4, format!("{a}.map(v, v + 1)")),
                    (4, format!("{a}.filter(v, v > j)")),
                    (2, format!("{a}.exists_one(v, v == 3)")),
                    (2, format!("{b} in {a}")),
                    (2, format!("{a} == [3, -1, 0]")),
                ]),
                (kind, _) => (kind, format!("({a} == {b} || {c} == {c} ? {a} : {a})")),
            }
        })
    });
    tree.prop_map(|(_, text)| text)
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 3000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn an_expression_gives_what_the_interpreter_of_the_crate_gives(text in drawn()) {
        let variables = variables();
        let names = variables.iter().map(|(name, kind, _)| ((*name).to_owned(), kind.clone()));
        let scope = Scope::declared(names, std::collections::HashMap::new());
        let Ok(expression) = read(&text, &scope) else { return Ok(()) };
        let values: Vec<Datum<'static>> = variables.iter().map(|(_, _, value)| value.clone()).collect();
        let own = expression.evaluate(&values).map(|value| as_value(&value));
        let mut context = Context::default();
        for (name, _, value) in &variables {
            context.add_variable_from_value(*name, as_value(value));
        }
        let known = Program::compile(&text).unwrap().execute(&context);
        match (own, known) {
            (Ok(own), Ok(known)) => prop_assert_eq!(format!("{own:?}"), format!("{known:?}"), "{}", text),
            (own, known) => prop_assert_eq!(own.is_ok(), known.is_ok(), "{}: {:?} and {:?}", text, own, known),
        }
    }
}

/// The value of an expression of undeclared variables, of which each name has the value that it is.
fn open(text: &str, values: &[(&str, Datum<'static>)]) -> String {
    let mut names = Vec::new();
    let expression = read_all(&[text], &Scope::open(), &mut names).unwrap().remove(0).unwrap();
    let value =
        |name: &String| values.iter().find(|(known, _)| known == name).map_or(Datum::Null, |(_, value)| value.clone());
    let values: Vec<Datum<'static>> = names.iter().map(value).collect();
    match expression.evaluate(&values) {
        Ok(value) => value.to_string(),
        Err(failure) => format!("{}: {}", expression.place(failure.offset), failure.detail),
    }
}

#[test]
fn where_types_are_not_declared_numbers_mix_and_null_decides_nothing() {
    let values = [("east_m", Datum::Double(3.0)), ("opening", Datum::Double(0.75)), ("arm.angle", Datum::Double(90.0))];
    for (text, expected) in [
        ("east_m / 0.25", "12"),
        ("east_m / 2", "1.5"),
        ("int(east_m) % 2", "1"),
        ("opening > 0.5 ? 'open' : 'shut'", "\"open\""),
        ("arm.angle / 45 + 1", "3"),
        ("missing + 1", "null"),
        ("missing == null ? 'none' : 'some'", "\"none\""),
        ("missing == 3", "null"),
        ("missing > 3 || east_m > 2", "true"),
        ("missing > 3 && east_m > 2", "null"),
        ("[missing, 1] in [[1, 1], [2, 1]]", "null"),
        ("missing in [1, 2, 3, 4, 5, 6, 7, 8, 9]", "null"),
        ("math.floor(east_m / 2)", "1"),
        ("'a' + east_m", "column 5: this cannot be done with string (\"a\") and double (3)"),
        ("[1, 2][int(east_m)]", "column 7: a list of 2 has no item 3"),
    ] {
        assert_eq!(open(text, &values), expected, "{text}");
    }
}

#[test]
fn what_grows_without_end_or_is_long_to_look_at_is_given_up() {
    let long = Datum::text(&"a".repeat(50_000));
    let ints = Datum::list((0..20_000).map(Datum::Int).collect());
    let values = [("s", long), ("l", ints)];
    assert_eq!(open("size(s + s)", &values), "100000");
    for text in [
        &format!("size({})", ["s"; 100].join(" + ")),
        &format!("size({})", ["l"; 100].join(" + ")),
        &format!("{} > 0", ["size(s)"; 100].join(" + ")),
        &["s == s"; 100].join(" && "),
        &["s.contains('b')"; 100].join(" || "),
        &format!("l.all(x, size([{}]) > 0)", ["x"; 900].join(", ")),
        &"size(l.map(x, s + s)) > 0".to_owned(),
    ] {
        let told = open(text, &values);
        assert!(told.contains("it takes more than 10000 steps"), "{text}: {told}");
    }
}

#[test]
fn a_place_is_told_by_characters() {
    let scope = Scope::declared([("x".to_owned(), Type::Int)], std::collections::HashMap::new());
    let flaws = |text: &str| read(text, &scope).unwrap_err();
    assert_eq!(flaws("'\u{e9}' == '\u{e9}' && y")[0].split(':').next(), Some("column 15"));
    assert_eq!(flaws("x == 1 &&\n  y")[0].split(':').next(), Some("line 2, column 3"));
}

#[test]
fn what_is_no_expression_is_told_in_plain_words() {
    let told = |text: &str| {
        let read = read_all(&[text], &Scope::open(), &mut Vec::new()).unwrap();
        read.into_iter().next().unwrap().unwrap_err().remove(0)
    };
    for (text, expected) in [
        ("x +", "column 4: the expression ends too early"),
        ("x + )", "column 5: `)` is not expected here"),
        ("1 2", "column 3: `2` is not expected here"),
        ("x ==== 2", "column 5: `==` is not expected here"),
        ("[1,", "column 4: `]` is missing here"),
        ("a..b", "column 3: `..` is not expected here"),
        ("#", "column 1: `#` cannot be read"),
        ("'abc", "column 1: `'abc` cannot be read"),
        ("x ? 1", "column 1: a part is missing after this"),
    ] {
        assert_eq!(told(text), expected, "{text}");
    }
}
