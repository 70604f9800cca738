//! Faults that stand in many places alike.

use std::collections::HashMap;
use std::collections::hash_map::Entry;

use super::fault::{Fault, Faults};
use super::path::Path;

/// The faults of things that are alike, such as the observations of a demonstration. Who gets one wrong gets most of them wrong in the same
/// way, so each kind of fault is told once for each place within them: where it was found first, and how often it was found again.
#[derive(Debug, Default)]
pub struct Repeated {
    /// The first of each kind, with the number of further ones.
    first: Vec<(Fault, usize)>,
    /// Where those stand, by their place within the thing and what they say but for the value that was found.
    known: HashMap<(String, String), usize>,
    n_unlisted: usize,
}

impl Repeated {
    /// Takes in what is wrong with the thing at `path`.
    pub fn take_in(&mut self, faults: Faults, path: &Path<'_>) {
        if faults.is_empty() {
            return;
        }
        let n_prefix_bytes = path.to_string().len();
        self.n_unlisted += faults.count() - faults.listed().len();
        for fault in faults.into_listed() {
            let within = fault.pointer.get(n_prefix_bytes..).unwrap_or_default().to_owned();
            let said = fault.detail.split("found ").next().unwrap_or_default().to_owned();
            let is_full = self.first.len() == Faults::MAX_LISTED;
            match self.known.entry((within, said)) {
                Entry::Occupied(known) => self.first[*known.get()].1 += 1,
                Entry::Vacant(_) if is_full => self.n_unlisted += 1,
                Entry::Vacant(entry) => {
                    entry.insert(self.first.len());
                    self.first.push((fault, 0));
                }
            }
        }
    }

    /// Tells all of them; `things` is what they are of, more than one.
    pub fn tell(self, things: &str, faults: &mut Faults) {
        for (mut fault, n_more) in self.first {
            let more = match n_more {
                0 => String::new(),
                1 => " (and in 1 more)".to_owned(),
                n => format!(" (and in {n} more {things})"),
            };
            fault.detail.push_str(&more);
            faults.list(fault);
        }
        faults.count_unlisted(self.n_unlisted);
    }
}
