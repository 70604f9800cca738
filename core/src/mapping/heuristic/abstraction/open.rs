//! The open list of the backward search.

/// Nodes in the order of `f`, but for differences of a thousandth. Unlike that of the forward search, it needs no upper limit of `f`.
#[derive(Debug)]
pub(super) struct Open {
    /// The entry that came last to each bucket, plus 1; 0 for none.
    heads: Vec<u32>,
    entries: Vec<Entry>,
    /// The entry that was taken last, plus 1, to be filled again; 0 for none.
    free: u32,
    /// The leading bits of what is in the first bucket.
    first: u64,
    /// The bucket of which nodes are taken.
    current: usize,
}

#[derive(Clone, Copy, Debug)]
struct Entry {
    id: u32,
    /// The entry before it in its bucket, or before it among those that are free; as in the heads.
    next: u32,
}

/// Binary digits of `f` that do not matter: all but ten after the first.
const N_IGNORED: u32 = f64::MANTISSA_DIGITS - 1 - 10;

/// How many buckets there are: what costs 256 times the least is never looked at.
const N_BUCKETS: usize = 1 << 13;

impl Open {
    /// How much memory a node takes, in bytes.
    pub(super) const NODE_BYTES: usize = size_of::<Entry>();

    /// An empty list, for nodes of which those whose `f` is less than `least`, which is above 0, need not be told apart.
    pub(super) fn new(least: f64) -> Self {
        let first = least.to_bits() >> N_IGNORED;
        Self { heads: vec![0; N_BUCKETS], entries: Vec::new(), free: 0, first, current: 0 }
    }

    /// Adds a node. By rounding, its `f` may be a little less than those that were taken.
    #[inline]
    pub(super) fn push(&mut self, f: f64, id: u32) {
        let bucket = ((f.to_bits() >> N_IGNORED).saturating_sub(self.first) as usize).max(self.current);
        let Some(head) = self.heads.get_mut(bucket) else { return };
        let entry = Entry { id, next: *head };
        if let Some(free) = (self.free as usize).checked_sub(1) {
            *head = self.free;
            self.free = std::mem::replace(&mut self.entries[free], entry).next;
        } else {
            self.entries.push(entry);
            #[expect(clippy::cast_possible_truncation, reason = "tables have fewer than 2^32 entries")]
            let entry = self.entries.len() as u32;
            *head = entry;
        }
    }

    /// Takes a node of the current bucket.
    #[inline]
    pub(super) fn pop(&mut self) -> Option<u32> {
        let head = self.heads.get_mut(self.current)?;
        let entry = (*head as usize).checked_sub(1)?;
        let Entry { id, next } = self.entries[entry];
        self.entries[entry].next = self.free;
        self.free = *head;
        *head = next;
        Some(id)
    }

    /// Goes on to the next bucket that has nodes, the current one being empty. Gives what the `f` of those is at least, and of all that were
    /// left out.
    pub(super) fn advance(&mut self) -> f64 {
        while self.heads.get(self.current) == Some(&0) {
            self.current += 1;
        }
        // What is less than the first bucket is for is in that one.
        if self.current == 0 { 0.0 } else { f64::from_bits((self.first + self.current as u64) << N_IGNORED) }
    }

    /// Whether no nodes are left.
    pub(super) fn is_empty(&self) -> bool {
        self.current >= self.heads.len()
    }

    /// How much memory it takes, in bytes.
    pub(super) fn size_bytes(&self) -> usize {
        size_of_val(self.heads.as_slice()) + size_of_val(self.entries.as_slice())
    }
}
