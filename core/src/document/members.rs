//! Objects taken apart into their members, each of which stays text until it is known what to read it as.

use std::borrow::Cow;
use std::slice;

use serde_json::{Map, Value};

use super::parsing::parse;
use super::size::parsed_bytes;

/// The members of an object, as text.
///
/// A request is mostly its demonstration, which is read several times as fast once its model is known. So its members are told apart
/// first, by their quotes and brackets alone: in one pass that copies nothing and takes a fraction of the time of reading. Whether a
/// member is JSON, finds whoever reads it.
#[derive(Debug)]
pub struct Members<'t> {
    names: &'static [&'static str],
    /// By name.
    texts: Vec<Option<&'t str>>,
}

impl<'t> Members<'t> {
    /// The members of the object in `text`, which may have these names, each once. `None` if
    /// the text is something else; [`parse`](super::parse) and [`Place::object`](super::Place::object) tell what is wrong with it.
    #[must_use]
    pub fn split(text: &'t str, names: &'static [&'static str]) -> Option<Self> {
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let mut rest = Rest::of(text);
        let mut texts = vec![None; names.len()];
        rest.mark(b"{")?;
        let mut mark = b',';
        while mark != b'}' {
            let name = match rest.value()? {
                name if name.contains('\\') => serde_json::from_str::<String>(name).ok()?.into(),
                name => Cow::Borrowed(name.strip_prefix('"')?.strip_suffix('"')?),
            };
            let position = names.iter().position(|known| *known == name)?;
            rest.mark(b":")?;
            if texts[position].replace(rest.value()?).is_some() {
                return None;
            }
            mark = rest.mark(b",}")?;
        }
        rest.skip_blanks();
        rest.peek().is_none().then_some(Self { names, texts })
    }

    /// Takes the text of the member called `name` out.
    pub fn take(&mut self, name: &str) -> Option<&'t str> {
        let position = self.names.iter().position(|known| *known == name)?;
        self.texts[position].take()
    }

    /// About how much memory the members take once they are parsed, in bytes: up to eighty times as much as their text.
    #[must_use]
    pub fn parsed_bytes(&self) -> usize {
        self.texts.iter().flatten().map(|text| parsed_bytes(text.as_bytes())).sum()
    }

    /// How many bytes the texts of the members are.
    #[must_use]
    pub fn n_bytes(&self) -> usize {
        self.texts.iter().flatten().map(|text| text.len()).sum()
    }

    /// The members as an object. `None` if one of them cannot be held, as [`parse`](super::parse) tells.
    #[must_use]
    pub fn parse(&self) -> Option<Value> {
        let mut object = Map::new();
        for (name, text) in self.names.iter().zip(&self.texts) {
            if let Some(text) = text {
                object.insert((*name).to_owned(), parse(text.as_bytes()).ok()?);
            }
        }
        Some(Value::Object(object))
    }
}

/// What is left of a text.
struct Rest<'t> {
    text: &'t str,
    left: slice::Iter<'t, u8>,
}

impl<'t> Rest<'t> {
    fn of(text: &'t str) -> Self {
        Self { text, left: text.as_bytes().iter() }
    }

    fn at(&self) -> usize {
        self.text.len() - self.left.len()
    }

    fn peek(&self) -> Option<u8> {
        self.left.as_slice().first().copied()
    }

    fn skip_while(&mut self, is_skipped: impl Fn(u8) -> bool) {
        while self.peek().is_some_and(&is_skipped) {
            self.left.next();
        }
    }

    fn skip_blanks(&mut self) {
        self.skip_while(|byte| b" \t\n\r".contains(&byte));
    }

    /// Takes what comes next, blanks aside, if it is one of `marks`.
    fn mark(&mut self, marks: &[u8]) -> Option<u8> {
        self.skip_blanks();
        self.left.next().copied().filter(|mark| marks.contains(mark))
    }

    /// Takes the text of the value that comes next, blanks aside.
    fn value(&mut self) -> Option<&'t str> {
        self.skip_blanks();
        let from = self.at();
        match self.peek()? {
            b'"' | b'{' | b'[' => self.skip_brackets()?,
            // A number or a word.
            _ => self.skip_while(|byte| !b" \t\n\r,:}]".contains(&byte)),
        }
        Some(&self.text[from..self.at()]).filter(|value| !value.is_empty())
    }

    /// Goes past a string, or past a bracket and the one that closes it, of whatever kind.
    fn skip_brackets(&mut self) -> Option<()> {
        let mut depth = 0_usize;
        loop {
            match self.left.next()? {
                b'"' => self.skip_to_quote()?,
                b'{' | b'[' => depth += 1,
                b'}' | b']' => depth -= 1,
                _ => continue,
            }
            if depth == 0 {
                return Some(());
            }
        }
    }

    /// Goes past the quote that ends a string.
    fn skip_to_quote(&mut self) -> Option<()> {
        loop {
            match self.left.next()? {
                b'"' => return Some(()),
                b'\\' => {
                    self.left.next()?;
                }
                _ => {}
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::json;

    use super::*;

    /// What texts of objects are put together of.
    const PIECES: [&str; 22] = [
        r#""model":"#,
        r#""start":"#,
        r#" "st\u0061rt" : "#,
        r#""other":"#,
        ",",
        ", ",
        ":",
        " ",
        "{",
        "}",
        "[",
        "]",
        "7",
        "-1.5e3",
        "null",
        r#""""#,
        r#""a\"b,{""#,
        r#""\\""#,
        r#""\u00e9é""#,
        r#""x":[1,{"y":"]"}]"#,
        "\"",
        "\\",
    ];

    const NAMES: [&str; 3] = ["model", "demonstration", "start"];

    #[test]
    fn members_are_told_apart_in_whatever_order_and_form_they_stand() {
        for text in [
            r#"{"model":"a","demonstration":[{"model":"b"}],"start":7}"#,
            r#" { "start" : 7 , "demonstration" : [{"model":"b"}] , "m\u006fdel" : "a" } "#,
            "\u{feff}{\"model\":\"a\",\"demonstration\":[{\"model\":\"b\"}],\"start\":7}",
        ] {
            let mut members = Members::split(text, &NAMES).unwrap();
            assert_eq!(members.take("demonstration"), Some(r#"[{"model":"b"}]"#), "{text}");
            assert_eq!(members.take("demonstration"), None);
            assert_eq!(members.parse(), Some(json!({"model": "a", "start": 7})), "{text}");
            assert_eq!(members.n_bytes(), 4);
        }
    }

    #[test]
    fn what_is_no_object_of_these_members_is_left_to_be_explained() {
        for text in [
            "",
            "[]",
            "7",
            "{}",
            r#"{"model""#,
            r#"{"model":"#,
            r#"{"model":}"#,
            r#"{"model":"a""#,
            r#"{"model":"a\"#,
            r#"{"model":"a},"#,
            r#"{"model":"a",}"#,
            r#"{"model":"a" "start":7}"#,
            r#"{"model","start":7}"#,
            r#"{"model":"a"} x"#,
            r#"{"start":[{"x":1}}"#,
            r#"{"start":[[]]]}"#,
            r#"{model:"a"}"#,
            r#"{"mod\el":"a"}"#,
            r#"{"hurry":1}"#,
            r#"{"model":"b","start":{},"model":"a"}"#,
        ] {
            assert!(Members::split(text, &NAMES).is_none(), "{text}");
        }
    }

    #[test]
    fn whether_a_member_is_json_finds_whoever_reads_it() {
        for text in [
            r#"{"start":1e999}"#,
            r#"{"start":{"x":1,"x":1}}"#,
            r#"{"model":01}"#,
            r#"{"model":yes}"#,
            r#"{"model":"\q"}"#,
            "{\"model\":\"a\nb\"}",
            r#"{"start":[1,2}}"#,
            r#"{"start":[1 2]}"#,
            r#"{"start":[],"model":a"b}"#,
        ] {
            assert_eq!(Members::split(text, &NAMES).unwrap().parse(), None, "{text}");
        }
    }

    proptest! {
        /// Against the parser: whatever it reads as an object of these members is told apart as it reads them, and what it does not read is
        /// told apart by nobody who reads all members.
        #[test]
        fn members_are_those_that_a_parser_reads(pieces in prop::collection::vec(prop::sample::select(&PIECES[..]), 0..12)) {
            let text = format!("{{{}}}", pieces.concat());
            let parsed = parse(text.as_bytes()).ok().filter(|value| {
                value.as_object().is_some_and(|members| !members.is_empty() && members.keys().all(|name| NAMES.contains(&&**name)))
            });
            let split = Members::split(&text, &NAMES).and_then(|members| members.parse());
            prop_assert_eq!(split, parsed, "{}", text);
        }
    }
}
