//! The core against its definition: mappings, whole and in the making, of models known in full and of those searched lazily.

#![expect(
    clippy::unwrap_used,
    clippy::too_many_lines,
    clippy::cast_possible_truncation,
    reason = "tests may panic, and are read top to bottom"
)]

mod cases;
mod compiling;
mod conditions;
mod experience;
mod implicit;
mod imports;
mod inspection;
mod lazy;
mod mapping;
mod online;
mod oracle;
mod problems;
#[cfg(feature = "rules")]
mod rules;
