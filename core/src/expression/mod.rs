//! Expressions of the Common Expression Language (CEL): checked once, evaluated often.
//!
//! The crate `cel` parses them. What it gives is made into nodes whose names are looked up and whose types are checked, so that evaluating
//! them needs neither; interpreting the crate's own tree takes names and boxes at every step.
//!
//! ```text
//! text --cel--> its tree --Scope--> Expression( Node ) --evaluate(variables)--> Datum
//! ```
//!
//! | supported | what |
//! |---|---|
//! | values | `int`, `double`, `bool`, `string`, `list`, `null` |
//! | operators | `+ - * / %`, `== != < <= > >=`, `&& \|\| !`, `in`, `[]`, `? :` |
//! | functions | `size`, `int`, `double`, `string`, `startsWith`, `endsWith`, `contains` |
//! | of the library `math` | `greatest`, `least`, `abs`, `sign`, `floor`, `ceil`, `round`, `trunc` |
//! | macros | `all`, `exists`, `exists_one`, `map`, `filter` |
//!
//! Where the types of variables are [declared](Scope::declared), they are checked as CEL says: an `int` and a `double` are not added.
//! Where [they are not](Scope::open), an `int` beside a `double` is read as one, and what needs a `null` is `null`.

mod checking;
mod datum;
mod evaluating;
mod names;
mod node;
mod parsing;
mod told;

pub(crate) use checking::Type;
pub(crate) use datum::Datum;
pub(crate) use evaluating::Failure;
use node::Node;
pub(crate) use parsing::{Scope, read_all};

/// An expression, ready to be evaluated.
#[derive(Clone, Debug)]
pub(crate) struct Expression {
    text: Box<str>,
    root: Node,
    result: Type,
    /// The variables that it reads, by their numbers, ascending.
    reads: Box<[usize]>,
}

impl Expression {
    /// As it was written.
    pub(crate) fn text(&self) -> &str {
        &self.text
    }

    /// The type of its values.
    pub(crate) fn result(&self) -> &Type {
        &self.result
    }

    /// The numbers of the variables that it reads, ascending.
    pub(crate) fn reads(&self) -> &[usize] {
        &self.reads
    }

    /// About how many nodes an evaluation comes to at most.
    pub(crate) fn work(&self) -> u64 {
        self.root.work()
    }

    /// The constants that it may give, as far as they can be told without evaluating it, with the places where they stand.
    pub(crate) fn constant_results(&self) -> Vec<(u32, &Datum<'static>)> {
        let mut found = Vec::new();
        self.root.collect_results(&mut found);
        found
    }

    /// Its value where the variables have these values, by their numbers.
    ///
    /// # Errors
    ///
    /// [`Failure`] if it has none, such as the quotient of a division by zero.
    pub(crate) fn evaluate<'a>(&'a self, variables: &'a [Datum<'a>]) -> Result<Datum<'a>, Failure> {
        evaluating::evaluate(&self.root, variables)
    }

    /// Where in the text the character at the byte `offset` stands, in words.
    pub(crate) fn place(&self, offset: u32) -> String {
        told::place_in(&self.text, offset)
    }
}

#[cfg(test)]
mod tests;
