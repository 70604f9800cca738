//! Hashes of what is registered.

use std::io;

use etude_core::model::Definition;
use sha2::{Digest, Sha256};

/// SHA-256 of a text, in hexadecimal: of a canonical one, equal for equal content, however that was written.
#[must_use]
pub fn hash_of(canonical: impl AsRef<[u8]>) -> String {
    hex(Sha256::digest(canonical))
}

/// [`hash_of`] the canonical text of a definition, which is not kept.
///
/// # Errors
///
/// If a definition cannot be written, which none of the kinds that there are is known to do.
pub fn hash_of_definition(definition: &Definition) -> io::Result<String> {
    let mut digest = Sha256::new();
    definition.write(&mut digest)?;
    Ok(hex(digest.finalize()))
}

/// A digest in hexadecimal.
pub(super) fn hex(digest: impl std::fmt::LowerHex) -> String {
    format!("{digest:x}")
}
