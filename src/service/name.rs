//! Names that clients give to what they register.

use std::fmt;

/// A name: 1 to 64 of `a-z A-Z 0-9 . _ -`, but neither `.` nor `..`, which clients take out of paths.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Name(String);

/// A text is not a [`Name`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("expected a name of 1 to 64 of a-z A-Z 0-9 . _ -, other than . and ..")]
pub struct InvalidName;

impl Name {
    /// Longest name, in characters.
    pub const MAX_CHARS: usize = 64;

    /// Checks a name.
    ///
    /// # Errors
    ///
    /// [`InvalidName`] if `text` is empty, longer than [`Self::MAX_CHARS`], `.` or `..`, or has other characters.
    pub fn new(text: impl Into<String>) -> Result<Self, InvalidName> {
        let text = text.into();
        let is_allowed = |byte: u8| byte.is_ascii_alphanumeric() || b"._-".contains(&byte);
        let is_valid =
            (1..=Self::MAX_CHARS).contains(&text.len()) && text.bytes().all(is_allowed) && text != "." && text != "..";
        if is_valid { Ok(Self(text)) } else { Err(InvalidName) }
    }

    /// The name as text.
    #[must_use]
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// What has a name or an id.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A model.
    Model,
    /// A policy.
    Policy,
    /// A learner.
    Learner,
    /// A session.
    Session,
    /// A trial.
    Trial,
}

impl Kind {
    /// What it is called in problems.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Model => "model",
            Self::Policy => "policy",
            Self::Learner => "learner",
            Self::Session => "session",
            Self::Trial => "trial",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_one_to_64_plain_characters_and_are_no_steps_in_a_path() {
        for name in ["a", "A.b_c-9", "...", ".a", &"x".repeat(64)] {
            assert!(Name::new(name).is_ok(), "{name}");
        }
        for name in ["", ".", "..", "a b", "a/b", "é", &"x".repeat(65)] {
            assert!(Name::new(name).is_err(), "{name}");
        }
    }
}
