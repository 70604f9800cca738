//! Rows of different lengths, side by side in memory.

use std::convert::Infallible;

/// Rows of items in one array (compressed sparse rows).
#[derive(Clone, Debug)]
pub(crate) struct Rows<T> {
    /// `offsets[n]..offsets[n + 1]` are the items of row `n`. Shape `[n_rows + 1]`, or empty if there are none.
    offsets: Vec<u32>,
    items: Vec<T>,
}

impl<T> Default for Rows<T> {
    fn default() -> Self {
        Self { offsets: Vec::new(), items: Vec::new() }
    }
}

impl<T: Copy> Rows<T> {
    /// `n_rows` rows of what `entries` gives, each with its row; a row's items stay in order. It iterates over them twice (counting sort), so that
    /// nothing but the rows takes memory. `O(n_rows + n_entries)`.
    ///
    /// # Panics
    ///
    /// If there are 2^32 entries or more.
    pub(crate) fn of_entries(n_rows: usize, entries: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let Ok(rows) = Self::try_of_entries(n_rows, entries, || Ok::<_, Infallible>(()));
        rows
    }

    /// As [`Self::of_entries`]; `go_on` is called before each entry, in both passes.
    ///
    /// # Errors
    ///
    /// What `go_on` said.
    ///
    /// # Panics
    ///
    /// If there are 2^32 entries or more.
    pub(crate) fn try_of_entries<E>(
        n_rows: usize,
        entries: impl Iterator<Item = (u32, T)> + Clone,
        mut go_on: impl FnMut() -> Result<(), E>,
    ) -> Result<Self, E> {
        // First `offsets[n + 1]` is where row `n` begins, and moves on as items are put in; in the end it is where it ends.
        let mut offsets = vec![0u32; n_rows + 1];
        let mut n_entries = 0usize;
        let mut any = None;
        for (row, item) in entries.clone() {
            go_on()?;
            n_entries += 1;
            any = Some(item);
            if let Some(next) = offsets.get_mut(row as usize + 2) {
                *next += 1;
            }
        }
        assert!(u32::try_from(n_entries).is_ok(), "fewer than 2^32 entries");
        for row in 2..=n_rows {
            offsets[row] += offsets[row - 1];
        }
        let mut items = any.map_or(Vec::new(), |any| vec![any; n_entries]);
        for (row, item) in entries {
            go_on()?;
            let next = &mut offsets[row as usize + 1];
            items[*next as usize] = item;
            *next += 1;
        }
        Ok(Self { offsets, items })
    }

    /// Adds a row.
    ///
    /// # Panics
    ///
    /// If there come to be 2^32 items or more.
    pub(crate) fn push(&mut self, items: impl Iterator<Item = T>) {
        if self.offsets.is_empty() {
            self.offsets.push(0);
        }
        self.items.extend(items);
        self.offsets.push(u32::try_from(self.items.len()).expect("fewer than 2^32 items"));
    }

    /// Rows of what `map` makes of the items, without those of which it makes nothing.
    pub(crate) fn filter_map<U>(&self, mut map: impl FnMut(&T) -> Option<U>) -> Rows<U> {
        let (mut offsets, mut items) = (Vec::with_capacity(self.offsets.len()), Vec::new());
        offsets.push(0);
        for row in self.iter() {
            items.extend(row.iter().filter_map(&mut map));
            #[expect(clippy::cast_possible_truncation, reason = "no more than there were")]
            offsets.push(items.len() as u32);
        }
        Rows { offsets, items }
    }

    /// Rows of the same lengths.
    pub(crate) fn map<U>(&self, map: impl FnMut(&T) -> U) -> Rows<U> {
        Rows { offsets: self.offsets.clone(), items: self.items.iter().map(map).collect() }
    }

    /// Removes from each row every item that `merge(last, item)` says it has merged into `last`, the last item that was kept before it.
    pub(crate) fn dedup(&mut self, mut merge: impl FnMut(&mut T, &T) -> bool) {
        let mut end = 0;
        for n in 0..self.n_rows() {
            let row = self.range(n);
            let first = end;
            #[expect(clippy::cast_possible_truncation, reason = "no more than there were")]
            {
                self.offsets[n] = first as u32;
            }
            for at in row {
                let item = self.items[at];
                if end == first || !merge(&mut self.items[end - 1], &item) {
                    self.items[end] = item;
                    end += 1;
                }
            }
        }
        #[expect(clippy::cast_possible_truncation, reason = "no more than there were")]
        if let Some(last) = self.offsets.last_mut() {
            *last = end as u32;
        }
        self.items.truncate(end);
    }
}

impl<T> Rows<T> {
    /// Where the items of a row stand among all items.
    #[inline]
    pub(crate) fn range(&self, row: usize) -> std::ops::Range<usize> {
        self.offsets[row] as usize..self.offsets[row + 1] as usize
    }

    /// The items of a row.
    #[inline]
    pub(crate) fn of(&self, row: usize) -> &[T] {
        &self.items[self.range(row)]
    }

    /// All items, row by row.
    #[inline]
    pub(crate) fn items(&self) -> &[T] {
        &self.items
    }

    /// The items of a row.
    pub(crate) fn of_mut(&mut self, row: usize) -> &mut [T] {
        let range = self.range(row);
        &mut self.items[range]
    }

    /// Every row.
    pub(crate) fn iter(&self) -> impl Iterator<Item = &[T]> + Clone {
        self.offsets.windows(2).map(|bounds| &self.items[bounds[0] as usize..bounds[1] as usize])
    }

    /// How many rows there are.
    pub(crate) fn n_rows(&self) -> usize {
        self.offsets.len().saturating_sub(1)
    }

    /// How many items there are.
    pub(crate) fn n_items(&self) -> usize {
        self.items.len()
    }

    /// Returns memory that was reserved and is not used.
    pub(crate) fn shrink_to_fit(&mut self) {
        self.items.shrink_to_fit();
    }

    /// Size in memory, in bytes.
    pub(crate) fn size_bytes(&self) -> usize {
        size_of_val(self.offsets.as_slice()) + size_of_val(self.items.as_slice())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn rows_hold_their_entries_in_order_and_lose_those_that_are_merged(
            entries in prop::collection::vec((0..6_u32, 0..3_u32), 0..40),
            n_rows in 6..9_usize,
        ) {
            let mut rows = Rows::of_entries(n_rows, entries.iter().copied());
            let wanted = |n: usize| {
                let of_row = entries.iter().filter(|(row, _)| *row as usize == n).map(|(_, item)| *item);
                of_row.collect::<Vec<_>>()
            };
            prop_assert_eq!((rows.n_rows(), rows.n_items()), (n_rows, entries.len()));
            for n in 0..n_rows {
                prop_assert_eq!(rows.of(n), &wanted(n)[..]);
            }
            rows.dedup(|last, item| last == item);
            for (n, row) in rows.iter().enumerate() {
                let mut wanted = wanted(n);
                wanted.dedup();
                prop_assert_eq!(row, &wanted[..]);
            }
            let doubled = rows.map(|item| item * 2);
            prop_assert_eq!(doubled.n_items(), rows.n_items());
        }
    }
}
