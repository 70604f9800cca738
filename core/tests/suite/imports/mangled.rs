//! Files that were cut, changed and made up: each is read or refused, and none makes a reader panic or take memory without end.

use super::{edits, file};
use crate::problems::example_bytes;
use etude_core::interrupt::Uninterrupted;
use etude_core::model::{ImportFormat, Limits, import};
use proptest::prelude::*;

/// As little as a service might allow.
const LIMITS: Limits = Limits { max_states: 1000, max_transitions: 10_000, max_values: 1 << 20, max_bytes: 1 << 22 };

/// A file of each format.
fn files() -> Vec<(ImportFormat, Vec<u8>)> {
    vec![
        (ImportFormat::Gymnasium, example_bytes("gymnasium/frozen-lake.json")),
        (ImportFormat::Sas, example_bytes("planning/blocksworld-4.sas")),
        (ImportFormat::Drn, example_bytes("verification/slippery.drn")),
        (ImportFormat::Umb, super::verification::umb("slippery")),
        (ImportFormat::Prism, super::verification::archive()),
    ]
}

fn read(format: ImportFormat, content: &[u8]) -> bool {
    let costs = if matches!(format, ImportFormat::Drn | ImportFormat::Umb) { &["energy"][..] } else { &["*=1"] };
    import(format, vec![file("", content)], &edits(&[], costs), LIMITS, &mut Uninterrupted).is_ok()
}

#[derive(Clone, Debug)]
enum Change {
    Cut(prop::sample::Index),
    Byte(prop::sample::Index, u8),
    /// Another number in place of the one that follows.
    Number(prop::sample::Index, &'static str),
    Repeat(prop::sample::Index, prop::sample::Index),
    Drop(prop::sample::Index, prop::sample::Index),
}

fn change() -> impl Strategy<Value = Change> {
    let at = any::<prop::sample::Index>;
    let number =
        prop::sample::select(vec!["0", "-1", "1", "7", "4294967295", "18446744073709551615", "1e999", "nan", ""]);
    prop_oneof![
        at().prop_map(Change::Cut),
        (at(), any::<u8>()).prop_map(|(at, byte)| Change::Byte(at, byte)),
        (at(), number).prop_map(|(at, number)| Change::Number(at, number)),
        (at(), at()).prop_map(|(from, to)| Change::Repeat(from, to)),
        (at(), at()).prop_map(|(from, to)| Change::Drop(from, to)),
    ]
}

fn changed(mut content: Vec<u8>, changes: &[Change]) -> Vec<u8> {
    for change in changes {
        if content.is_empty() {
            break;
        }
        let n_bytes = content.len();
        let range = |from: &prop::sample::Index, to: &prop::sample::Index| {
            let (from, to) = (from.index(n_bytes), to.index(n_bytes));
            from.min(to)..from.max(to)
        };
        match change {
            Change::Cut(at) => content.truncate(at.index(n_bytes)),
            Change::Byte(at, byte) => content[at.index(n_bytes)] = *byte,
            Change::Number(at, number) => {
                let is_digit = |byte: &u8| byte.is_ascii_digit();
                let from = at.index(n_bytes);
                let Some(begin) = content[from..].iter().position(is_digit).map(|n| from + n) else { continue };
                let n_digits = content[begin..].iter().take_while(|byte| is_digit(byte)).count();
                content.splice(begin..begin + n_digits, number.bytes());
            }
            Change::Repeat(from, to) => {
                let repeated = content[range(from, to)].to_vec();
                content.extend(repeated);
            }
            Change::Drop(from, to) => drop(content.drain(range(from, to))),
        }
    }
    content
}

#[test]
fn files_are_read_within_these_limits() {
    for (format, content) in files() {
        assert!(read(format, &content), "{}", format.name());
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_mangled_file_is_read_or_refused(number in 0usize..5, changes in prop::collection::vec(change(), 1..6)) {
        let (format, content) = files().swap_remove(number);
        read(format, &changed(content, &changes));
    }

    #[test]
    fn any_bytes_are_read_or_refused(number in 0usize..5, content in prop::collection::vec(any::<u8>(), 0..2000)) {
        read(ImportFormat::ALL[number], &content);
    }
}
