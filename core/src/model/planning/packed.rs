//! States of many attributes with few values each, in as few words as they need.

/// How many bits a word has.
const WORD_BITS: u32 = u64::BITS;

/// The state of a planning task: its values, packed.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct PackedState(Words);

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
enum Words {
    Few([u64; 2]),
    Many(Box<[u64]>),
}

impl PackedState {
    fn words(&self) -> &[u64] {
        match &self.0 {
            Words::Few(words) => words,
            Words::Many(words) => words,
        }
    }

    fn words_mut(&mut self) -> &mut [u64] {
        match &mut self.0 {
            Words::Few(words) => words,
            Words::Many(words) => words,
        }
    }
}

/// Where the value of each attribute is in a packed state.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Layout {
    fields: Vec<Field>,
    n_words: usize,
}

/// The bits of a value: in one word.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Field {
    word: usize,
    shift: u32,
    mask: u64,
}

impl Layout {
    /// A layout for attributes with so many values each.
    pub(super) fn new(n_values: impl Iterator<Item = usize>) -> Self {
        let (mut word, mut shift) = (0, 0);
        let fields = n_values.map(|n_values| {
            let n_bits = (n_values.max(2) - 1).ilog2() + 1;
            if shift + n_bits > WORD_BITS {
                (word, shift) = (word + 1, 0);
            }
            let field = Field { word, shift, mask: (1 << n_bits) - 1 };
            shift += n_bits;
            field
        });
        let fields: Vec<Field> = fields.collect();
        Self { n_words: fields.last().map_or(0, |field| field.word + 1), fields }
    }

    /// The state with these values, by their indices.
    pub(super) fn pack(&self, values: impl Iterator<Item = u32>) -> PackedState {
        let words = match self.n_words {
            0..=2 => Words::Few([0; 2]),
            n_words => Words::Many(vec![0; n_words].into()),
        };
        let mut state = PackedState(words);
        for (attribute, value) in values.enumerate() {
            self.set(&mut state, attribute, value);
        }
        state
    }

    #[inline]
    pub(super) fn get(&self, state: &PackedState, attribute: usize) -> u32 {
        let Field { word, shift, mask } = self.fields[attribute];
        #[expect(clippy::cast_possible_truncation, reason = "fields have at most 32 bits")]
        let value = (state.words()[word] >> shift & mask) as u32;
        value
    }

    #[inline]
    pub(super) fn set(&self, state: &mut PackedState, attribute: usize, value: u32) {
        let Field { word, shift, mask } = self.fields[attribute];
        let word = &mut state.words_mut()[word];
        *word = *word & !(mask << shift) | u64::from(value) << shift;
    }

    /// The values of a state.
    pub(super) fn unpack(&self, state: &PackedState) -> impl Iterator<Item = u32> {
        (0..self.fields.len()).map(|attribute| self.get(state, attribute))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_packed_is_unpacked() {
        for n_attributes in [1, 5, 40, 200] {
            let n_values = |n: u32| [1, 2, 3, 4, 5, 17, 65_536, 1000][n as usize % 8];
            let layout = Layout::new((0..n_attributes).map(|n| n_values(n) as usize));
            let values: Vec<u32> = (0..n_attributes).map(|n| n * 7919 % n_values(n)).collect();
            let mut state = layout.pack(values.iter().copied());
            assert_eq!(layout.unpack(&state).collect::<Vec<_>>(), values);
            for (attribute, value) in values.iter().enumerate() {
                let last = n_values(u32::try_from(attribute).unwrap()) - 1;
                layout.set(&mut state, attribute, last);
                assert_eq!(layout.get(&state, attribute), last);
                layout.set(&mut state, attribute, *value);
            }
            assert_eq!(state, layout.pack(values.into_iter()));
        }
    }
}
