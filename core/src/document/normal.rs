//! Texts that are written differently and mean the same.

use std::borrow::Cow;

/// `text` in Unicode's normalization form C: there, a letter and the accent that follows it are the letter with the accent, so that texts that look
/// alike are equal. Without the feature `unicode`, as it is.
#[must_use]
pub fn normal(text: &str) -> Cow<'_, str> {
    // Most texts are, and cost no more than this.
    if text.is_ascii() { Cow::Borrowed(text) } else { normalized(text) }
}

#[cfg(feature = "unicode")]
fn normalized(text: &str) -> Cow<'_, str> {
    use unicode_normalization::{UnicodeNormalization, is_nfc};
    if is_nfc(text) { Cow::Borrowed(text) } else { Cow::Owned(text.nfc().collect()) }
}

#[cfg(not(feature = "unicode"))]
fn normalized(text: &str) -> Cow<'_, str> {
    Cow::Borrowed(text)
}

#[cfg(all(test, feature = "unicode"))]
mod tests {
    use super::*;

    #[test]
    fn texts_that_look_alike_are_equal() {
        assert_eq!(normal("gro\u{308}\u{df}e"), "gr\u{f6}\u{df}e");
        assert!(matches!(normal("gr\u{f6}\u{df}e"), Cow::Borrowed(_)));
        assert!(matches!(normal("size"), Cow::Borrowed(_)));
    }
}
