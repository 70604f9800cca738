//! Which values the states of a model have, looked up rather than searched for.

use std::hash::{BuildHasher, RandomState};

use hashbrown::HashTable;

use crate::attribute::{Kind, Value};

/// The values that states have of an attribute.
#[derive(Debug)]
pub(super) enum Reach {
    /// Numbers, from the least to the greatest.
    Numbers { least: f64, greatest: f64 },
    /// So few that they are compared one by one.
    Few,
    /// Where each of them stands in the domain. Hashed with a seed, as clients choose the values.
    Many { positions: HashTable<u32>, hasher: RandomState },
}

/// So many values are compared one by one in less time than hashing takes.
const FEW: usize = 16;

impl Reach {
    /// Whether one of the states has this `value`, of an attribute with this `domain`. `O(1)`.
    pub(super) fn has(&self, value: &Value, domain: &[Value]) -> bool {
        match self {
            Self::Numbers { .. } | Self::Few => domain.contains(value),
            Self::Many { positions, hasher } => {
                positions.find(hasher.hash_one(value), |position| domain[*position as usize] == *value).is_some()
            }
        }
    }

    pub(super) fn of(kind: &Kind, domain: &[Value]) -> Self {
        if let Kind::Number { .. } = kind {
            let numbers = domain.iter().map(|value| if let Value::Number(number) = value { *number } else { 0.0 });
            let least = numbers.clone().fold(f64::INFINITY, f64::min);
            return Self::Numbers { least, greatest: numbers.fold(f64::NEG_INFINITY, f64::max) };
        }
        if domain.len() <= FEW {
            return Self::Few;
        }
        let hasher = RandomState::default();
        let mut positions = HashTable::with_capacity(domain.len());
        for (value, position) in domain.iter().zip(0u32..) {
            positions
                .insert_unique(hasher.hash_one(value), position, |known| hasher.hash_one(&domain[*known as usize]));
        }
        Self::Many { positions, hasher }
    }
}
