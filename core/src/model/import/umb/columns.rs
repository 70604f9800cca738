//! Columns of an archive.

use crate::model::import::{ImportError, Spot};

/// A column of bits.
pub(super) struct Bits<'a>(pub(super) &'a [u8]);

impl Bits<'_> {
    pub(super) fn has(&self, n: u64) -> bool {
        let byte = usize::try_from(n / 8).ok().and_then(|byte| self.0.get(byte));
        byte.is_some_and(|byte| byte >> (n % 8) & 1 == 1)
    }
}

/// A column of numbers of eight bytes.
pub(super) struct Words<'a> {
    pub(super) name: String,
    pub(super) bytes: &'a [[u8; 8]],
}

impl Words<'_> {
    pub(super) fn whole(&self, n: u64) -> u64 {
        usize::try_from(n).ok().and_then(|n| self.bytes.get(n)).map_or(0, |bytes| u64::from_le_bytes(*bytes))
    }

    pub(super) fn float(&self, n: u64) -> f64 {
        f64::from_bits(self.whole(n))
    }

    fn wrong(&self, n: u64, detail: String) -> ImportError {
        ImportError::at(Spot::Byte(n.saturating_mul(8)), detail).in_file(&self.name)
    }
}

/// Where the parts of each of several things begin; each has one part if it is not said.
pub(super) struct Ranges<'a>(pub(super) Option<Words<'a>>);

impl Ranges<'_> {
    /// The parts of `n`, of `n_parts` in all.
    pub(super) fn of(&self, n: u64, n_parts: u64) -> Result<(u64, u64), ImportError> {
        let Some(begins) = &self.0 else { return Ok((n, n + 1)) };
        let (begin, end) = (begins.whole(n), begins.whole(n + 1));
        if begin <= end && end <= n_parts {
            return Ok((begin, end));
        }
        Err(begins.wrong(n, format!("the parts from {begin} to {end}, of {n_parts}")))
    }
}
