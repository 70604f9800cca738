//! Archives of files (POSIX ustar and pax, and GNU's long names), read into memory.
//!
//! Crates for archives are made for file systems, and bring what touches them; of an archive, only the names and contents of its files are needed here.

use std::io::{BufRead, Read as _};

use super::{ImportError, Spot};
use crate::document::Quoted;

const BLOCK: usize = 512;

/// Reads the files of an archive, each with its name, of at most `max_bytes` in all.
///
/// # Errors
///
/// [`ImportError::Malformed`] with the byte, also where the archive ends early; [`ImportError::TooLarge`].
pub(super) fn read_archive(mut reader: impl BufRead, max_bytes: u64) -> Result<Vec<(String, Vec<u8>)>, ImportError> {
    let mut files = Vec::new();
    let mut at = 0;
    // The name of the next file, if it does not fit into its header.
    let mut long_name: Option<String> = None;
    loop {
        let header = read_exact(&mut reader, at, BLOCK as u64)?;
        let begin = Spot::Byte(at);
        if header.iter().all(|byte| *byte == 0) {
            return Ok(files);
        }
        at += BLOCK as u64;
        check(&header).map_err(|detail| ImportError::at(begin, detail))?;
        let n_bytes = octal(&header[124..136]).ok_or_else(|| ImportError::at(begin, "a file without a size"))?;
        if at.saturating_add(n_bytes) > max_bytes {
            return Err(ImportError::TooLarge(format!("the archive has over {max_bytes} bytes, the limit")));
        }
        let content = read_exact(&mut reader, at, n_bytes)?;
        let padding = n_bytes.next_multiple_of(BLOCK as u64) - n_bytes;
        read_exact(&mut reader, at + n_bytes, padding)?;
        at += n_bytes + padding;
        match header[156] {
            0 | b'0' => {
                let name = long_name.take().unwrap_or_else(|| name(&header));
                files.push((name.trim_start_matches("./").to_owned(), content));
            }
            b'L' => long_name = Some(text(&content)),
            b'x' => long_name = pax_path(&content).or(long_name),
            // Folders, and what holds for all files.
            b'5' | b'g' => long_name = None,
            kind => {
                let detail = format!("{} is neither a file nor a folder (type {kind})", Quoted(&name(&header)));
                return Err(ImportError::at(begin, detail));
            }
        }
    }
}

/// Reads `n_bytes`, of which no more memory is taken than come.
fn read_exact(reader: &mut impl BufRead, at: u64, n_bytes: u64) -> Result<Vec<u8>, ImportError> {
    let mut bytes = Vec::new();
    reader.by_ref().take(n_bytes).read_to_end(&mut bytes)?;
    if (bytes.len() as u64) < n_bytes {
        let spot = Spot::Byte(at + bytes.len() as u64);
        return Err(ImportError::at(spot, format!("the archive ends, {} bytes early", n_bytes - bytes.len() as u64)));
    }
    Ok(bytes)
}

/// Checks a header against its sum, which counts itself as blanks.
fn check(header: &[u8]) -> Result<(), String> {
    let own = 148..156;
    let sum: u64 =
        header.iter().enumerate().map(|(n, byte)| u64::from(if own.contains(&n) { b' ' } else { *byte })).sum();
    match octal(&header[own.clone()]) {
        Some(expected) if expected == sum => Ok(()),
        _ => Err("this is no header of a file in a tar archive".to_owned()),
    }
}

fn octal(field: &[u8]) -> Option<u64> {
    let digits = text(field);
    u64::from_str_radix(digits.trim(), 8).ok()
}

fn text(field: &[u8]) -> String {
    let end = field.iter().position(|byte| *byte == 0).unwrap_or(field.len());
    String::from_utf8_lossy(&field[..end]).into_owned()
}

fn name(header: &[u8]) -> String {
    let (name, prefix) = (text(&header[..100]), text(&header[345..500]));
    if &header[257..262] == b"ustar" && header[262] == 0 && !prefix.is_empty() {
        format!("{prefix}/{name}")
    } else {
        name
    }
}

/// The path that a pax header gives: one of its records, each `length name=value`.
fn pax_path(content: &[u8]) -> Option<String> {
    let records = String::from_utf8_lossy(content);
    let path = records.lines().find_map(|record| record.split_once(' ')?.1.strip_prefix("path="));
    path.map(str::to_owned)
}
