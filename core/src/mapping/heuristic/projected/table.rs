//! The entries of all columns.

/// What each class costs at each observation. Those of a class are one after the other, so that what a state costs at neighbouring
/// observations is read together.
#[derive(Debug, Default)]
pub(in crate::mapping::heuristic) struct Table<T> {
    /// Shape `[n_classes, stride]`.
    entries: Vec<T>,
    /// The observations, with room for whole chunks of [`CHUNK_LEN`].
    stride: usize,
}

/// How many observations are read together.
pub(in crate::mapping) const CHUNK_LEN: usize = 8;

/// How many entries there are for each class: those of whole chunks. If these are many, their number is odd, as tables are made by
/// going through all classes at each observation: with a stride of a large power of two, few of the cache's sets would hold these.
pub(super) fn stride_for(n_observations: usize) -> usize {
    const MANY: usize = 8;
    let n_chunks = n_observations.div_ceil(CHUNK_LEN);
    let n_chunks = if n_chunks < MANY { n_chunks } else { n_chunks | 1 };
    n_chunks * CHUNK_LEN
}

impl<T: Copy> Table<T> {
    /// The same entry everywhere.
    pub(in crate::mapping::heuristic) fn filled_with(entry: T, n_classes: usize, n_observations: usize) -> Self {
        Self {
            entries: vec![entry; Self::n_entries_for(n_classes, n_observations)],
            stride: stride_for(n_observations),
        }
    }

    /// How many entries a table has, with the room.
    pub(in crate::mapping::heuristic) fn n_entries_for(n_classes: usize, n_observations: usize) -> usize {
        n_classes.saturating_mul(stride_for(n_observations))
    }

    /// Size in memory, in bytes.
    pub(in crate::mapping::heuristic) fn size_bytes(&self) -> usize {
        size_of_val(self.entries.as_slice())
    }

    /// How many there are, with the room.
    #[cfg(test)]
    pub(super) fn n_entries(&self) -> usize {
        self.entries.len()
    }

    /// What a class costs at an observation.
    #[inline]
    pub(in crate::mapping::heuristic) fn at(&self, class: usize, observation: usize) -> T {
        self.entries[class * self.stride + observation]
    }

    #[inline]
    pub(in crate::mapping::heuristic) fn at_mut(&mut self, class: usize, observation: usize) -> &mut T {
        &mut self.entries[class * self.stride + observation]
    }

    /// What a class costs at each observation, and as many more as there is room for.
    pub(super) fn of(&self, class: usize) -> &[T] {
        &self.entries[class * self.stride..][..self.stride]
    }

    /// The same, to be written.
    pub(super) fn of_mut(&mut self, class: usize) -> &mut [T] {
        &mut self.entries[class * self.stride..][..self.stride]
    }

    /// What a class costs at the observations of the chunk that begins with `first`.
    #[inline]
    pub(super) fn chunk(&self, class: usize, first: usize) -> Option<&[T; CHUNK_LEN]> {
        self.entries.get(class * self.stride + first..)?.first_chunk()
    }
}
