//! When models last changed, for those who remember something of them.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use rustc_hash::FxHashMap;

/// Most models of which each is known when it changed.
const MAX_NAMES: usize = 1024;

/// The generations of models: the database counts registrations, changes and deletions, and a model's generation is that count as it was when it
/// last changed, or a later one. They are known from the time on at which the writer's connection was opened until it is closed. Clones share
/// them.
#[derive(Clone, Debug, Default)]
pub(super) struct Generations(Arc<Mutex<Option<Known>>>);

#[derive(Debug)]
struct Known {
    newest: u64,
    /// Of models that have changed of late, by name.
    changed: FxHashMap<String, u64>,
    /// Of all others.
    of_others: u64,
}

impl Known {
    fn from(newest: u64) -> Self {
        Self { newest, changed: FxHashMap::default(), of_others: newest }
    }
}

impl Generations {
    fn known(&self) -> MutexGuard<'_, Option<Known>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The generation of the model called `name`, be it there or not; `None` if it is not known now.
    pub(super) fn of(&self, name: &str) -> Option<u64> {
        let known = self.known();
        let known = known.as_ref()?;
        Some(known.changed.get(name).copied().unwrap_or(known.of_others))
    }

    pub(super) fn are_known(&self) -> bool {
        self.known().is_some()
    }

    /// They are known from now on, and this is the newest.
    pub(super) fn begin(&self, newest: u64) {
        *self.known() = Some(Known::from(newest));
    }

    /// They are not known any more.
    pub(super) fn forget(&self) {
        *self.known() = None;
    }

    /// A model has changed, and with it the count.
    pub(super) fn note(&self, name: String, generation: u64) {
        let mut known = self.known();
        let Some(known) = known.as_mut() else { return };
        // Somebody else has changed models in between, who knows which.
        if generation != known.newest + 1 || known.changed.len() >= MAX_NAMES {
            *known = Known::from(generation);
        }
        known.newest = generation;
        known.changed.insert(name, generation);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_change_of_a_model_is_none_of_another_unless_somebody_else_has_changed_some() {
        let generations = Generations::default();
        assert_eq!(generations.of("a"), None);
        generations.note("a".to_owned(), 4);
        assert_eq!(generations.of("a"), None);
        generations.begin(4);
        assert!(generations.of("a") == Some(4) && generations.are_known());
        generations.note("a".to_owned(), 5);
        generations.note("b".to_owned(), 6);
        assert_eq!(["a", "b", "c"].map(|name| generations.of(name)), [5, 6, 4].map(Some));
        generations.note("a".to_owned(), 8);
        assert_eq!(["a", "b", "c"].map(|name| generations.of(name)), [8; 3].map(Some));
        for n in 0..MAX_NAMES as u64 {
            generations.note(format!("other {n}"), 9 + n);
        }
        assert!(generations.of("a") > Some(8), "not all are known that have changed");
        generations.forget();
        assert_eq!(generations.of("a"), None);
    }
}
