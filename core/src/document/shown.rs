//! How values and names are shown in faults: never at length.

use std::fmt;

use serde_json::Value;

/// A value as it is shown in a fault: whole if short, else its kind.
pub(crate) struct Excerpt<'v>(pub(crate) &'v Value);

impl fmt::Display for Excerpt<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.0 {
            Value::Array(items) => write!(f, "an array of {}", items.len()),
            Value::Object(_) => f.write_str("an object"),
            Value::String(text) => Quoted(text).fmt(f),
            other => write!(f, "{other}"),
        }
    }
}

/// A text as it is shown in a fault: quoted, and cut if it is long.
pub struct Quoted<'t>(pub &'t str);

impl fmt::Display for Quoted<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        /// Most characters shown: enough to recognize a name by.
        const MAX_SHOWN: usize = 60;
        let cut = self.0.char_indices().nth(MAX_SHOWN).map(|(end, _)| &self.0[..end]);
        let ellipsis = if cut.is_some() { ".." } else { "" };
        write!(f, "{}{ellipsis}", Value::from(cut.unwrap_or(self.0)))
    }
}

/// Names that would have been right, as they are listed in a fault: the first few.
pub(crate) fn list_known<N: AsRef<str>>(names: impl IntoIterator<Item = N>) -> String {
    /// Most names listed. There may be tens of thousands, and a fault for every state.
    const MAX_KNOWN: usize = 10;
    let mut names = names.into_iter();
    let mut known: Vec<String> = names.by_ref().take(MAX_KNOWN).map(|name| Quoted(name.as_ref()).to_string()).collect();
    known.extend(names.next().map(|_| "..".to_owned()));
    known.join(", ")
}
