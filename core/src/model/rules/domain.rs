//! The values that states may have of an attribute.

use std::collections::HashMap;

use crate::attribute::{Attribute, Cycle, Kind, Scalar, Value, ValuesDocument};
use crate::document::{Faults, Object, Path, Place, Range, list_known, whole};
use crate::expression::{Datum, Type};

/// Most values of all attributes together.
pub(super) const MAX_VALUES: usize = 1 << 20;

/// The values that states may have of an attribute, in order: as they are compared, and as expressions see them.
#[derive(Clone, Debug)]
pub(super) struct Domain {
    values: Values,
    kind: Type,
    /// As they are written in JSON; `None`: they are the labels.
    document: Option<ValuesDocument>,
}

#[derive(Clone, Debug)]
enum Values {
    /// Whole numbers, evenly apart, `len` of them. They are not kept: a few bytes of a definition may tell of many.
    Whole { from: i64, step: i64, len: u32 },
    /// Others, as they are compared, and as expressions see them.
    Listed { values: Vec<Value>, data: Vec<Datum<'static>>, lookup: Lookup },
}

/// How a value is found.
#[derive(Clone, Debug)]
enum Lookup {
    /// Numbers, evenly apart.
    Even { from: f64, step: f64 },
    /// Anything. Hashed with a seed, as clients choose the values.
    Known(HashMap<Datum<'static>, u32>),
}

impl Domain {
    /// Reads the member `values` of an attribute, or takes its labels. There may be at most `most`.
    pub(super) fn read(
        attribute: &Attribute,
        object: &Object<'_, '_>,
        most: usize,
        faults: &mut Faults,
    ) -> Option<Self> {
        if let Kind::Cyclic { cycle: Cycle::Labels(labels), .. } = &attribute.kind {
            if let Some(place) = object.optional("values") {
                faults.note(&place, "the values are the `labels`; leave this out");
                return None;
            }
            let values = (0..).zip(labels.names()).map(|(label, name)| (Value::Label(label), Datum::text(name)));
            return Some(Self::of(values.collect(), Type::Text, None));
        }
        let place = object.required("values", faults)?;
        if place.value.is_array() {
            Self::read_list(attribute, &place, most, faults)
        } else {
            Self::read_even(attribute, &place, most, faults)
        }
    }

    fn of(values: Vec<(Value, Datum<'static>)>, kind: Type, document: Option<ValuesDocument>) -> Self {
        let (values, data): (Vec<_>, Vec<_>) = values.into_iter().unzip();
        let known = data.iter().cloned().zip(0..).collect();
        Self { values: Values::Listed { values, data, lookup: Lookup::Known(known) }, kind, document }
    }

    fn read_list(attribute: &Attribute, place: &Place<'_, '_>, most: usize, faults: &mut Faults) -> Option<Self> {
        let items = place.array(faults)?;
        if items.is_empty() || items.len() > most {
            return place.mismatch(&expected(most), faults);
        }
        let n_before = faults.count();
        let read = |(n, item)| attribute.read_value(&place.item(n, item), faults);
        let values: Vec<Option<Value>> = items.iter().enumerate().map(read).collect();
        let values: Vec<Value> = values.into_iter().collect::<Option<_>>()?;
        let mut known = HashMap::new();
        for (n, value) in values.iter().enumerate() {
            if known.insert(value, n).is_some() {
                faults.note_at(&Path::Item(&place.path, n), "this value stands twice");
            }
        }
        let are_whole = values.iter().all(|value| matches!(value, Value::Number(number) if whole(*number).is_some()));
        let data: Vec<Datum<'static>> = values.iter().map(|value| datum_of(value, are_whole)).collect();
        let kinds = data.iter().map(Datum::type_name);
        if kinds.clone().any(|kind| kind != data[0].type_name()) {
            faults.note(
                place,
                "values of one type are needed, as expressions are checked: all strings, all integers or all booleans",
            );
        }
        let kind = match &data[0] {
            Datum::Int(_) => Type::Int,
            Datum::Double(_) => Type::Double,
            Datum::Bool(_) => Type::Bool,
            _ => Type::Text,
        };
        let document = ValuesDocument::List(values.iter().map(|value| attribute.write_value(value)).collect());
        (faults.count() == n_before).then(|| Self::of(values.into_iter().zip(data).collect(), kind, Some(document)))
    }

    fn read_even(attribute: &Attribute, place: &Place<'_, '_>, most: usize, faults: &mut Faults) -> Option<Self> {
        if attribute.kind == Kind::Category {
            return place.mismatch("an array of values", faults);
        }
        if !place.value.is_object() {
            return place.mismatch("an object with `from`, `to` and `step`, or an array of values", faults);
        }
        let object = place.object(&["from", "to", "step"], faults)?;
        let from = object.required("from", faults).and_then(|place| place.number(Range::Finite, faults));
        let to = object.required("to", faults).and_then(|place| place.number(Range::Finite, faults));
        let step = match object.optional("step") {
            Some(place) => place.number(Range::Positive, faults),
            None => Some(1.0),
        };
        let (from, to, step) = (from?, to?, step?);
        let n_steps = ((to - from) / step).round();
        // Of the steps, each may be off by a rounding error.
        let is_whole = ((to - from) / step - n_steps).abs() <= 1e-9 * n_steps.max(1.0);
        #[expect(clippy::cast_precision_loss, reason = "a small number")]
        let is_allowed = to >= from && n_steps < most as f64;
        if !is_allowed {
            let detail = format!("expected {}, found those from {from} to {to} by {step}", expected(most));
            faults.note(place, detail);
            return None;
        }
        if !is_whole {
            faults.note(place, format!("{to} is not {from} and a whole number of steps of {step}"));
            return None;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "checked to be small")]
        let n_values = n_steps as u32 + 1;
        let document = Some(ValuesDocument::Range { from, to, step: Some(step) });
        if let (Some(from), Some(_), Some(step)) = (whole(from), whole(to), whole(step)) {
            return Some(Self { values: Values::Whole { from, step, len: n_values }, kind: Type::Int, document });
        }
        let number = |n: u32| match n {
            0 => from,
            _ if n + 1 == n_values => to,
            // Three steps of 0.1 are 0.3, and not the float after it.
            _ => shortest(from + f64::from(n) * step),
        };
        let values: Vec<Value> = (0..n_values).map(|n| Value::Number(number(n) + 0.0)).collect();
        let data = values.iter().map(|value| datum_of(value, false)).collect();
        let values = Values::Listed { values, data, lookup: Lookup::Even { from, step } };
        Some(Self { values, kind: Type::Double, document })
    }

    /// The values, as they are compared.
    pub(super) fn values(&self) -> Vec<Value> {
        match &self.values {
            Values::Whole { len, .. } => (0..*len).map(|index| self.value(index)).collect(),
            Values::Listed { values, .. } => values.clone(),
        }
    }

    /// The value at `index`, as it is compared.
    pub(super) fn value(&self, index: u32) -> Value {
        match &self.values {
            #[expect(clippy::cast_precision_loss, reason = "whole numbers between two that are floats of their own")]
            Values::Whole { from, step, .. } => Value::Number((from + i64::from(index) * step) as f64),
            Values::Listed { values, .. } => values[index as usize].clone(),
        }
    }

    /// How many there are.
    #[expect(clippy::cast_possible_truncation, reason = "at most MAX_VALUES")]
    pub(super) fn len(&self) -> u32 {
        match &self.values {
            Values::Whole { len, .. } => *len,
            Values::Listed { values, .. } => values.len() as u32,
        }
    }

    /// The value at `index`, as expressions see it.
    #[inline]
    pub(super) fn datum(&self, index: u32) -> Datum<'_> {
        match &self.values {
            Values::Whole { from, step, .. } => Datum::Int(from + i64::from(index) * step),
            Values::Listed { data, .. } => data[index as usize].borrowed(),
        }
    }

    /// The type that expressions see.
    pub(super) fn kind(&self) -> &Type {
        &self.kind
    }

    /// As they are written in JSON.
    pub(super) fn document(&self) -> Option<ValuesDocument> {
        self.document.clone()
    }

    /// Where a value stands, if it is one of them; a number may be off by a rounding error.
    #[inline]
    pub(super) fn position(&self, datum: &Datum<'_>) -> Option<u32> {
        match (&self.values, datum) {
            (Values::Whole { from, step, len }, Datum::Int(number)) => {
                let above = number.checked_sub(*from)?;
                // Division takes longer than the rest.
                let index = if *step == 1 { above } else { (above % step == 0).then_some(above / step)? };
                u32::try_from(index).ok().filter(|index| index < len)
            }
            #[expect(clippy::cast_precision_loss, reason = "both are floats of their own")]
            (Values::Whole { from, step, .. }, Datum::Double(number)) => {
                self.nearest(*number, *from as f64, *step as f64)
            }
            (Values::Whole { .. }, _) => None,
            (Values::Listed { lookup: Lookup::Known(known), .. }, _) => known.get(datum).copied(),
            (Values::Listed { lookup: Lookup::Even { from, step }, .. }, _) => match datum {
                #[expect(clippy::cast_precision_loss, reason = "what is out of precision is out of the domain")]
                Datum::Int(number) => self.nearest(*number as f64, *from, *step),
                Datum::Double(number) => self.nearest(*number, *from, *step),
                _ => None,
            },
        }
    }

    /// Where the number next to this one stands, of numbers evenly apart, if they are the same but for a rounding error.
    fn nearest(&self, number: f64, from: f64, step: f64) -> Option<u32> {
        let n = ((number - from) / step).round();
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "too large a float is the largest u32"
        )]
        let index = (n >= 0.0 && n < f64::from(self.len())).then_some(n as u32)?;
        let Value::Number(value) = self.value(index) else { return None };
        ((number - value).abs() <= 1e-6 * step).then_some(index)
    }

    /// Where the value of an attribute stands, if it is one of them.
    pub(super) fn position_of(&self, value: &Value, attribute: &Attribute) -> Option<u32> {
        let datum = match value {
            Value::Label(_) => match attribute.write_value(value) {
                Scalar::Text(text) => Datum::text(&text),
                _ => return None,
            },
            _ => datum_of(value, false),
        };
        self.position(&datum)
    }

    /// Says that a value is none of them.
    pub(super) fn refusal(&self, datum: &Datum<'_>, name: &str) -> String {
        let values = if let Values::Listed { data, lookup: Lookup::Known(_), .. } = &self.values {
            format!("which are {}", list_known(data.iter().map(ToString::to_string).map(Unquoted)))
        } else {
            format!("which are {} to {}", self.datum(0), self.datum(self.len() - 1))
        };
        format!("this is {datum}, which is none of the values of {}, {values}", crate::document::Quoted(name))
    }
}

/// How many values there may be, in words, if there may be at most `most` beside those of attributes before.
fn expected(most: usize) -> String {
    let others = if most < MAX_VALUES { format!(" ({MAX_VALUES} of all attributes)") } else { String::new() };
    format!("1 to {most} values{others}")
}

/// A text that is not to be quoted again.
struct Unquoted(String);

impl AsRef<str> for Unquoted {
    fn as_ref(&self) -> &str {
        self.0.trim_matches('"')
    }
}

fn datum_of(value: &Value, is_whole: bool) -> Datum<'static> {
    match value {
        Value::Number(number) => match whole(*number).filter(|_| is_whole) {
            Some(number) => Datum::Int(number),
            None => Datum::Double(*number),
        },
        Value::Label(label) => Datum::Int((*label).into()),
        Value::Text(text) => Datum::text(text),
        Value::Integer(integer) => Datum::Int(*integer),
        Value::Boolean(flag) => Datum::Bool(*flag),
    }
}

/// The float of 15 digits next to this one.
fn shortest(number: f64) -> f64 {
    format!("{number:.14e}").parse().unwrap_or(number)
}
