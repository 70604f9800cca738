//! Attributes, schemas and values that a program makes, with errors as values.

use std::collections::HashSet;

use super::reading::exact;
use super::{Attribute, Cycle, Kind, Labels, MAX_COST, Scalar, Schema, Value, Weights};

/// Why an attribute, a schema, a model or a demonstration could not be built.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BuildError {
    /// There are too few or too many of something.
    #[error("expected {least} to {most} {what}, found {found}")]
    Count {
        /// What is counted.
        what: &'static str,
        /// Least allowed.
        least: usize,
        /// Most allowed.
        most: usize,
        /// How many there are.
        found: usize,
    },
    /// A name or a label is empty or too long.
    #[error("{name:?} is no name of 1 to {most} characters")]
    Name {
        /// The name.
        name: String,
        /// Most characters; for labels and texts, most bytes.
        most: usize,
    },
    /// A name or a label stands twice.
    #[error("{0:?} stands twice")]
    Twice(String),
    /// A number is outside its range.
    #[error("{what}: expected {expected}, found {found}")]
    Number {
        /// What the number is.
        what: String,
        /// Its range.
        expected: &'static str,
        /// The number.
        found: f64,
    },
    /// A value is not one of its attribute.
    #[error("attribute {attribute:?}: expected {expected}, found {found}")]
    Value {
        /// The attribute's name.
        attribute: String,
        /// What its values are.
        expected: String,
        /// The value.
        found: Scalar,
    },
    /// There is no state or action with this index.
    #[error("there is no {what} {index}")]
    Unknown {
        /// `state` or `action`.
        what: &'static str,
        /// Its index.
        index: u32,
    },
    /// Two transitions leave a state by the same action.
    #[error("two transitions leave state {state} by action {action:?}")]
    Ambiguous {
        /// The state.
        state: u32,
        /// The action's name.
        action: String,
    },
    /// The probabilities of an action's outcomes do not sum to 1.
    #[error("the probabilities of state {state} and action {action:?} sum to {sum}, not to 1")]
    Probabilities {
        /// The state.
        state: u32,
        /// The action's name.
        action: String,
        /// What they sum to.
        sum: f64,
    },
    /// The imitator cannot start in a state that must never be entered.
    #[error("state {0} is unsafe, so nothing starts there")]
    UnsafeStart(u32),
}

impl From<f64> for Scalar {
    fn from(number: f64) -> Self {
        Self::number(number)
    }
}

impl From<i64> for Scalar {
    fn from(integer: i64) -> Self {
        Self::Integer(integer)
    }
}

impl From<i32> for Scalar {
    fn from(integer: i32) -> Self {
        Self::Integer(integer.into())
    }
}

impl From<bool> for Scalar {
    fn from(flag: bool) -> Self {
        Self::Boolean(flag)
    }
}

impl From<&str> for Scalar {
    fn from(text: &str) -> Self {
        Self::Text(text.into())
    }
}

impl Attribute {
    /// Numbers on a line, with scale 1 and weight 1.
    ///
    /// ```
    /// use etude_core::attribute::Attribute;
    ///
    /// let x = Attribute::number("x").with_scale(0.5).with_weight(3.0);
    /// assert_eq!(x.term(x.weight, &x.value(1.0)?, &x.value(2)?), 12.0);
    /// # Ok::<(), etude_core::attribute::BuildError>(())
    /// ```
    #[must_use]
    pub fn number(name: impl Into<String>) -> Self {
        Self { name: name.into(), kind: Kind::Number { scale: 1.0 }, weight: 1.0, is_hidden: false }
    }

    /// Numbers on a circle of circumference `period`, with scale 1 and weight 1.
    #[must_use]
    pub fn cyclic(name: impl Into<String>, period: f64) -> Self {
        Self {
            name: name.into(),
            kind: Kind::Cyclic { scale: 1.0, cycle: Cycle::Period(period) },
            weight: 1.0,
            is_hidden: false,
        }
    }

    /// Labels, in order around a circle, one unit apart, with scale 1 and weight 1.
    #[must_use]
    pub fn labelled<L: AsRef<str>>(name: impl Into<String>, labels: impl IntoIterator<Item = L>) -> Self {
        let labels: Vec<L> = labels.into_iter().collect();
        let cycle = Cycle::Labels(Labels::new(labels.iter().map(AsRef::as_ref)));
        Self { name: name.into(), kind: Kind::Cyclic { scale: 1.0, cycle }, weight: 1.0, is_hidden: false }
    }

    /// Strings, integers and booleans without order, with weight 1.
    #[must_use]
    pub fn category(name: impl Into<String>) -> Self {
        Self { name: name.into(), kind: Kind::Category, weight: 1.0, is_hidden: false }
    }

    /// The same attribute, with another `scale`: the difference of values that counts as 1. A category has no scale and stays as it is.
    #[must_use]
    pub fn with_scale(self, scale: f64) -> Self {
        let kind = match self.kind {
            Kind::Number { .. } => Kind::Number { scale },
            Kind::Cyclic { cycle, .. } => Kind::Cyclic { scale, cycle },
            Kind::Category => Kind::Category,
        };
        Self { kind, ..self }
    }

    /// The same attribute with another default weight.
    #[must_use]
    pub fn with_weight(self, weight: f64) -> Self {
        Self { weight, ..self }
    }

    /// The same attribute, part of the state, but never observed nor compared. Its weight is 0.
    #[must_use]
    pub fn hidden(self) -> Self {
        Self { weight: 0.0, is_hidden: true, ..self }
    }

    /// The value of this attribute that is written as `scalar`.
    ///
    /// # Errors
    ///
    /// [`BuildError::Value`] if `scalar` is not a value of this attribute.
    pub fn value(&self, scalar: impl Into<Scalar>) -> Result<Value, BuildError> {
        let scalar = scalar.into();
        let value = match (&self.kind, &scalar) {
            (Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. }, Scalar::Number(number)) => {
                number.is_finite().then_some(Value::Number(number + 0.0))
            }
            (Kind::Number { .. } | Kind::Cyclic { cycle: Cycle::Period(_), .. }, Scalar::Integer(integer)) => {
                exact((*integer).into()).map(Value::Number)
            }
            (Kind::Cyclic { cycle: Cycle::Labels(labels), .. }, Scalar::Text(text)) => {
                labels.position(text).map(Value::Label)
            }
            (Kind::Category, Scalar::Text(text)) => Self::text(text).map(|text| Value::Text(text.into())),
            (Kind::Category, Scalar::Integer(integer)) => Some(Value::Integer(*integer)),
            (Kind::Category, Scalar::Boolean(flag)) => Some(Value::Boolean(*flag)),
            _ => None,
        };
        value.ok_or_else(|| BuildError::Value {
            attribute: self.name.clone(),
            expected: self.expected(),
            found: scalar,
        })
    }

    fn check(&self) -> Result<(), BuildError> {
        check_name(&self.name, Self::MAX_NAME_CHARS)?;
        let in_range = |what: &str, number: f64, expected, is_in: bool| {
            let what = || format!("{what} of attribute {:?}", self.name);
            if is_in { Ok(()) } else { Err(BuildError::Number { what: what(), expected, found: number }) }
        };
        let is_weight = self.weight.is_finite() && self.weight >= 0.0;
        in_range("weight", self.weight, "a finite number of at least 0", is_weight)?;
        if let Kind::Number { scale } | Kind::Cyclic { scale, .. } = &self.kind {
            in_range("scale", *scale, "a finite number above 0", scale.is_finite() && *scale > 0.0)?;
        }
        match &self.kind {
            Kind::Cyclic { cycle: Cycle::Period(period), .. } => {
                in_range("period", *period, "a finite number above 0", period.is_finite() && *period > 0.0)
            }
            Kind::Cyclic { cycle: Cycle::Labels(labels), .. } => {
                let names = labels.names();
                check_count("labels", 1, Labels::MAX_LABELS, names.len())?;
                let mut seen = HashSet::new();
                for name in names {
                    if name.len() > Self::MAX_TEXT_BYTES {
                        return Err(BuildError::Name { name: name.to_string(), most: Self::MAX_TEXT_BYTES });
                    }
                    if !seen.insert(name) {
                        return Err(BuildError::Twice(name.to_string()));
                    }
                }
                Ok(())
            }
            Kind::Number { .. } | Kind::Category => Ok(()),
        }
    }
}

impl Schema {
    /// The schema with these attributes, in order: 1 to [`Self::MAX_ATTRIBUTES`], of different names.
    ///
    /// ```
    /// use etude_core::attribute::{Attribute, BuildError, Schema};
    ///
    /// let schema = Schema::new([
    ///     Attribute::number("x"),
    ///     Attribute::labelled("heading", ["east", "north", "west", "south"]),
    ///     Attribute::category("door").with_weight(2.0),
    /// ])?;
    /// assert_eq!(schema.position("door"), Some(2));
    /// let twice = Schema::new([Attribute::number("x"), Attribute::category("x")]);
    /// assert_eq!(twice, Err(BuildError::Twice("x".to_owned())));
    /// # Ok::<(), BuildError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`BuildError::Count`], [`BuildError::Name`], [`BuildError::Twice`] or [`BuildError::Number`].
    pub fn new(attributes: impl IntoIterator<Item = Attribute>) -> Result<Self, BuildError> {
        let attributes: Vec<Attribute> = attributes.into_iter().collect();
        check_count("attributes", 1, Self::MAX_ATTRIBUTES, attributes.len())?;
        let mut names = HashSet::new();
        for attribute in &attributes {
            attribute.check()?;
            if !names.insert(attribute.name.as_str()) {
                return Err(BuildError::Twice(attribute.name.clone()));
            }
        }
        Ok(Self::of(attributes))
    }

    /// The default weights, with others for the attributes that `named` names.
    ///
    /// ```
    /// # use etude_core::attribute::{Attribute, BuildError, Schema};
    /// let schema = Schema::new([Attribute::number("x"), Attribute::category("door")])?;
    /// assert_eq!(schema.weights_with([("door", 5.0)])?.as_slice(), [1.0, 5.0]);
    /// # Ok::<(), BuildError>(())
    /// ```
    ///
    /// # Errors
    ///
    /// [`BuildError::Name`] if there is no such attribute, [`BuildError::Number`] if a weight is negative or not finite.
    pub fn weights_with<'n>(&self, named: impl IntoIterator<Item = (&'n str, f64)>) -> Result<Weights, BuildError> {
        let mut weights = self.weights();
        for (name, weight) in named {
            let position = self.position(name);
            let position =
                position.ok_or_else(|| BuildError::Name { name: name.to_owned(), most: Attribute::MAX_NAME_CHARS })?;
            check_cost(|| format!("weight of {name:?}"), weight, f64::MAX)?;
            weights.set(position, weight);
        }
        Ok(weights)
    }

    /// The values of a state, of which there must be one for each attribute.
    pub(crate) fn values(&self, scalars: impl IntoIterator<Item = Scalar>) -> Result<Vec<Value>, BuildError> {
        let scalars: Vec<Scalar> = scalars.into_iter().collect();
        check_count("values", self.len(), self.len(), scalars.len())?;
        self.attributes().iter().zip(scalars).map(|(attribute, scalar)| attribute.value(scalar)).collect()
    }
}

pub(crate) fn check_count(what: &'static str, least: usize, most: usize, found: usize) -> Result<(), BuildError> {
    if (least..=most).contains(&found) { Ok(()) } else { Err(BuildError::Count { what, least, most, found }) }
}

pub(crate) fn check_name(name: &str, most: usize) -> Result<(), BuildError> {
    let is_name = (1..=most).contains(&name.chars().count());
    if is_name { Ok(()) } else { Err(BuildError::Name { name: name.to_owned(), most }) }
}

/// Checks a cost or a weight: at least 0, at most `most`.
pub(crate) fn check_cost(what: impl FnOnce() -> String, cost: f64, most: f64) -> Result<(), BuildError> {
    if (0.0..=most).contains(&cost) {
        return Ok(());
    }
    let expected = if most == MAX_COST { "a number from 0 to 1e150" } else { "a finite number of at least 0" };
    Err(BuildError::Number { what: what(), expected, found: cost })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_attribute_is_told_with_its_name() {
        let is_refused = |attribute: Attribute| Schema::new([attribute]).unwrap_err().to_string();
        assert!(is_refused(Attribute::number("")).contains("no name"));
        assert!(is_refused(Attribute::number("x").with_scale(0.0)).contains("scale of attribute \"x\""));
        assert!(is_refused(Attribute::number("x").with_weight(f64::NAN)).contains("weight of attribute \"x\""));
        assert!(is_refused(Attribute::cyclic("x", -1.0)).contains("period of attribute \"x\""));
        assert_eq!(is_refused(Attribute::labelled("x", ["a", "b", "a"])), "\"a\" stands twice");
        assert!(is_refused(Attribute::labelled::<&str>("x", [])).contains("1 to"));
        assert!(Schema::new([]).unwrap_err().to_string().contains("attributes, found 0"));
    }

    #[test]
    fn a_value_is_its_attributes_or_told() {
        let heading = Attribute::labelled("heading", ["east", "north"]);
        assert_eq!(heading.value("north"), Ok(Value::Label(1)));
        assert!(heading.value("up").unwrap_err().to_string().contains("one of the labels"));
        let number = Attribute::number("x");
        assert_eq!((number.value(2), number.value(-0.0)), (Ok(Value::Number(2.0)), Ok(Value::Number(0.0))));
        assert!(number.value("2").is_err() && number.value(f64::INFINITY).is_err());
        assert_eq!(Attribute::category("door").value(true), Ok(Value::Boolean(true)));
        assert!(Attribute::category("door").value(0.5).is_err());
        let schema = Schema::new([number]).unwrap();
        assert!(schema.weights_with([("y", 1.0)]).is_err() && schema.weights_with([("x", -1.0)]).is_err());
    }
}
