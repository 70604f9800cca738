//! The labels of a cyclic attribute.

use std::collections::HashMap;
use std::sync::Arc;

use crate::document::normal;

/// The labels of a cyclic attribute, in order around the circle. At least 1, all different.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Labels {
    names: Vec<Arc<str>>,
    /// Where each name stands. Hashed with a seed, as clients choose the names.
    positions: HashMap<Arc<str>, u32>,
}

impl Labels {
    /// Most labels.
    pub const MAX_LABELS: usize = 65_536;

    /// Labels that should be at least 1 and at most [`Self::MAX_LABELS`], and all different, which the caller checks.
    pub(crate) fn new<N: Into<Arc<str>>>(names: impl Iterator<Item = N>) -> Self {
        let names: Vec<Arc<str>> = names.map(Into::into).collect();
        let positions: HashMap<_, _> = names.iter().cloned().zip(0..).collect();
        Self { names, positions }
    }

    /// As [`Self::new`].
    pub(crate) fn of<const N: usize>(names: [&str; N]) -> Self {
        Self::new(names.into_iter())
    }

    /// The labels, in order.
    #[must_use]
    pub fn names(&self) -> &[Arc<str>] {
        &self.names
    }

    /// Where the label `name` stands, from 0, however it is [normalized](normal). `O(1)`.
    #[must_use]
    pub fn position(&self, name: &str) -> Option<u32> {
        self.positions.get(name).or_else(|| self.positions.get(normal(name).as_ref())).copied()
    }
}
