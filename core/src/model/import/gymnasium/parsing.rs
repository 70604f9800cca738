//! Taking the JSON apart as it comes.

use std::cell::RefCell;
use std::fmt;

use serde::de::{DeserializeSeed, Deserializer, Error as _, IgnoredAny, MapAccess, SeqAccess, Visitor};
use serde_json::Value as Json;

use super::{FORMAT, ImportError, Outcome, Quoted, Reading, Spot};
use crate::document::Excerpt;
use crate::model::ActionIdx;

/// What an object may have beside states.
const MEMBERS: [&str; 7] = ["format", "environment", "attributes", "actions", "states", "start", "P"];

/// Where the visitors put what they find.
pub(super) type Shared<'t> = &'t RefCell<Reading>;

/// Does `act`; what goes wrong is kept, as the parser has its own errors.
fn keeping<T, E: serde::de::Error>(
    table: Shared<'_>,
    act: impl FnOnce(&mut Reading) -> Result<T, ImportError>,
) -> Result<T, E> {
    let mut table = table.borrow_mut();
    act(&mut table).map_err(|failure| {
        table.failure = Some(failure);
        E::custom("")
    })
}

/// The whole file.
#[derive(Clone, Copy)]
pub(super) struct Document<'t>(pub(super) Shared<'t>);

/// `P`: by state.
#[derive(Clone, Copy)]
struct States<'t>(Shared<'t>);

/// What `P` has of a state: by action.
#[derive(Clone, Copy)]
struct Actions<'t>(Shared<'t>, u64);

/// What it has of a state and an action.
#[derive(Clone, Copy)]
struct Outcomes<'t>(Shared<'t>, (u64, ActionIdx));

/// The values of states.
#[derive(Clone, Copy)]
struct Rows<'t>(Shared<'t>);

macro_rules! deserialize_any {
    ($($seed:ident),*) => {$(
        impl<'de> DeserializeSeed<'de> for $seed<'_> {
            type Value = ();

            fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
                deserializer.deserialize_any(self)
            }
        }
    )*};
}
deserialize_any!(Document, States, Actions, Outcomes, Rows);

impl<'de> Visitor<'de> for Document<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a table by state and action, or an object with one as its member `P`")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        while let Some(name) = members.next_key::<String>()? {
            if let Ok(state) = name.parse::<u64>() {
                self.0.borrow_mut().has_table = true;
                members.next_value_seed(StateSeed(self.0, state))?;
                continue;
            }
            match &*name {
                "P" => {
                    if std::mem::replace(&mut self.0.borrow_mut().has_table, true) {
                        return Err(A::Error::custom("`P` stands twice"));
                    }
                    members.next_value_seed(States(self.0))?;
                }
                "states" => members.next_value_seed(Rows(self.0))?,
                "attributes" => self.0.borrow_mut().attributes = Some(members.next_value()?),
                "actions" => self.0.borrow_mut().actions = Some(members.next_value()?),
                "start" => self.0.borrow_mut().start = Some(members.next_value()?),
                "format" => {
                    let found = members.next_value::<String>()?;
                    if found != FORMAT {
                        let detail = format!("this is of the format {}; {FORMAT} is read here", Quoted(&found));
                        return Err(A::Error::custom(detail));
                    }
                }
                "environment" => drop(members.next_value::<IgnoredAny>()?),
                "dynamics" => {
                    let detail = "this is a model already, which need not be imported: it has \"dynamics\"";
                    return Err(A::Error::custom(detail));
                }
                _ => {
                    let known = MEMBERS.join(", ");
                    return Err(A::Error::custom(format!("unknown member {}; there may be {known}", Quoted(&name))));
                }
            }
        }
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, items: A) -> Result<(), A::Error> {
        self.0.borrow_mut().has_table = true;
        States(self.0).visit_seq(items)
    }
}

/// One state of `P`.
#[derive(Clone, Copy)]
struct StateSeed<'t>(Shared<'t>, u64);

impl<'de> DeserializeSeed<'de> for StateSeed<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        let Self(table, state) = self;
        keeping(table, |table| table.begin_state(state))?;
        deserializer.deserialize_any(Actions(table, state))
    }
}

impl<'de> Visitor<'de> for States<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("an object or an array by state")
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        while let Some(name) = members.next_key::<String>()? {
            let state = name.parse().map_err(|_| A::Error::custom(format!("{} is no state", Quoted(&name))))?;
            members.next_value_seed(StateSeed(self.0, state))?;
        }
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        let mut state = 0;
        while items.next_element_seed(StateSeed(self.0, state))?.is_some() {
            state += 1;
        }
        Ok(())
    }
}

/// One action of a state.
#[derive(Clone, Copy)]
struct ActionSeed<'t>(Shared<'t>, u64, u64);

impl<'de> DeserializeSeed<'de> for ActionSeed<'_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        let Self(table, state, action) = self;
        let index = keeping(table, |table| table.begin_pair(state, action))?;
        deserializer.deserialize_any(Outcomes(table, (state, index)))?;
        keeping(table, |table| table.draft.end_pair(state, index, Spot::Pair(state, action)))
    }
}

impl<'de> Visitor<'de> for Actions<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "for state {} an object or an array by action", self.1)
    }

    fn visit_map<A: MapAccess<'de>>(self, mut members: A) -> Result<(), A::Error> {
        while let Some(name) = members.next_key::<String>()? {
            let action = name.parse().map_err(|_| A::Error::custom(format!("{} is no action", Quoted(&name))))?;
            members.next_value_seed(ActionSeed(self.0, self.1, action))?;
        }
        Ok(())
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        let mut action = 0;
        while items.next_element_seed(ActionSeed(self.0, self.1, action))?.is_some() {
            action += 1;
        }
        Ok(())
    }
}

impl<'de> Visitor<'de> for Outcomes<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (state, action) = self.1;
        write!(f, "for state {state} and action {action} outcomes [probability, next state, reward, terminated]")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        while let Some(outcome) = items.next_element_seed(OutcomeSeed(self.1))? {
            keeping(self.0, |table| table.push_way(self.1, outcome))?;
        }
        Ok(())
    }
}

/// One outcome.
struct OutcomeSeed((u64, ActionIdx));

impl<'de> DeserializeSeed<'de> for OutcomeSeed {
    type Value = Outcome;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Outcome, D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de> Visitor<'de> for OutcomeSeed {
    type Value = Outcome;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (state, action) = self.0;
        write!(f, "for state {state} and action {action} an outcome [probability, next state, reward, terminated]")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut parts: A) -> Result<Outcome, A::Error> {
        fn wrong<E: serde::de::Error>(what: &'static str) -> impl Fn(Option<&Json>) -> E {
            move |found| {
                let found = found.map_or_else(|| "nothing".to_owned(), |found| Excerpt(found).to_string());
                E::custom(format!("expected [probability, next state, reward, terminated], with {what}, found {found}"))
            }
        }
        let mut next = || parts.next_element::<Json>();
        let number = |found: Option<Json>, what| {
            found.as_ref().and_then(Json::as_f64).ok_or_else(|| wrong(what)(found.as_ref()))
        };
        let probability = number(next()?, "a number as its probability")?;
        let to = next()?;
        let to = to.as_ref().and_then(Json::as_u64).ok_or_else(|| wrong("the index of its next state")(to.as_ref()))?;
        let reward = number(next()?, "a number as its reward")?;
        let ended = next()?;
        let ended = ended
            .as_ref()
            .and_then(Json::as_bool)
            .ok_or_else(|| wrong("`true` or `false` at its end")(ended.as_ref()))?;
        match next()? {
            None => Ok((probability, to, reward, ended)),
            Some(more) => Err(wrong("nothing after these")(Some(&more))),
        }
    }
}

impl<'de> Visitor<'de> for Rows<'_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the values of each state: an array of arrays")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        while let Some(row) = items.next_element::<Json>()? {
            let row = row.as_array().map_or(std::slice::from_ref(&row), Vec::as_slice);
            keeping(self.0, |table| table.push_row(row))?;
        }
        Ok(())
    }
}
