//! Hashes of what is registered.

use sha2::{Digest, Sha256};

/// SHA-256 of a text, in hexadecimal: of a canonical one, equal for equal content, however that was written.
#[must_use]
pub fn hash_of(canonical: impl AsRef<[u8]>) -> String {
    hex(Sha256::digest(canonical))
}

/// A digest in hexadecimal.
pub(super) fn hex(digest: impl std::fmt::LowerHex) -> String {
    format!("{digest:x}")
}
