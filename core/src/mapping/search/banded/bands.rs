//! Bands of `f`.

/// A band's number, from that of the least `f` on.
pub(super) type BandIdx = u32;

/// Bands of `f`, all of one width.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bands {
    least: f64,
    /// How many there are for each unit of cost.
    density: f64,
}

impl Bands {
    /// As many bands between `least` and `limit`; one, if that is nothing.
    #[expect(clippy::cast_precision_loss, reason = "there are few")]
    pub(super) fn between(least: f64, limit: f64, n_bands: usize) -> Self {
        let density = n_bands as f64 / (limit - least);
        Self { least, density: if density.is_finite() { density } else { 0.0 } }
    }

    /// The band of an `f`, but none before `first`.
    #[inline]
    pub(super) fn of(self, f: f64, first: BandIdx) -> BandIdx {
        /// 2^52: the last bits of its sum with a number are that number, rounded.
        const LARGE: f64 = 4_503_599_627_370_496.0;
        let (band, first) = ((f - self.least) * self.density, f64::from(first));
        #[expect(clippy::cast_possible_truncation, reason = "there are few")]
        let band = (LARGE + if band > first { band } else { first }).to_bits() as BandIdx;
        band
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_are_in_the_order_of_f_from_the_first_on() {
        for (least, limit) in
            [(0.0, 1.0), (100.0, 178.4), (3.0e9, 3.0e9 + 1e-3), (5.0, 5.0), (5.0, 4.0), (0.0, f64::INFINITY)]
        {
            let bands = Bands::between(least, limit, 64);
            let fs = (-10..1000).map(|n| least + f64::from(n) / 1000.0 * (limit - least).clamp(0.0, 1e9));
            let numbers: Vec<BandIdx> = fs.map(|f| bands.of(f, 0)).collect();
            assert!(numbers.is_sorted() && numbers[0] == 0, "{least} {limit}: {numbers:?}");
            assert!(numbers[numbers.len() - 1] <= bands.of(limit, 0) && bands.of(limit, 0) <= 64, "{least} {limit}");
            assert_eq!(bands.of(least, 7), 7);
        }
    }
}
