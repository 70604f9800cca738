//! Data that was compressed (gzip, zstd), decompressed as it is read; where that fails, it is told at which byte of what was compressed.

use std::io::{self, BufRead, Read};

use flate2::bufread::MultiGzDecoder;
use zstd::stream::read::Decoder;

/// What data compressed by gzip begins with.
pub(crate) const GZIP: &[u8] = &[0x1f, 0x8b];
/// What data compressed by zstd begins with.
pub(crate) const ZSTD: &[u8] = &[0x28, 0xb5, 0x2f, 0xfd];

/// A reader of what is compressed in another.
pub(crate) enum Decompressed<R: BufRead> {
    /// By gzip; several members, one after the other, are one text.
    Gzip(Box<MultiGzDecoder<Counted<R>>>),
    /// By zstd; likewise several frames.
    Zstd(Decoder<'static, Counted<R>>),
}

impl<R: BufRead> Decompressed<R> {
    /// Reads what gzip has compressed.
    pub(crate) fn gzip(compressed: R) -> Self {
        Self::Gzip(Box::new(MultiGzDecoder::new(Counted::new(compressed))))
    }

    /// Reads what zstd has compressed, with a window of `2^max_window_log` bytes at most; as many as zstd allows by itself if `None`.
    ///
    /// # Errors
    ///
    /// If there is no memory for a decoder.
    pub(crate) fn zstd(compressed: R, max_window_log: Option<u32>) -> io::Result<Self> {
        let mut decoder = Decoder::with_buffer(Counted::new(compressed))?;
        if let Some(log) = max_window_log {
            decoder.window_log_max(log)?;
        }
        Ok(Self::Zstd(decoder))
    }

    fn compressed(&self) -> &Counted<R> {
        match self {
            Self::Gzip(decoder) => decoder.get_ref(),
            Self::Zstd(decoder) => decoder.get_ref(),
        }
    }
}

impl<R: BufRead> Read for Decompressed<R> {
    /// # Errors
    ///
    /// Those of the reader of what is compressed, as they are; [`io::ErrorKind::InvalidData`] if that ends early or is damaged, with the byte, from 0: up to
    /// which it was decompressed, to the block.
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = match self {
            Self::Gzip(decoder) => decoder.read(buffer),
            Self::Zstd(decoder) => decoder.read(buffer),
        };
        let Counted { n_read, has_ended, has_failed, .. } = self.compressed();
        match read {
            Err(error) if !has_failed => {
                let told = if *has_ended {
                    format!("compressed data ends early, at byte {n_read}")
                } else {
                    format!("compressed data is damaged near byte {n_read}: {error}")
                };
                Err(io::Error::new(io::ErrorKind::InvalidData, told))
            }
            read => read,
        }
    }
}

/// A decoder of zstd does not tell how far it came in what it was given. So it is given little at once.
const MAX_GIVEN_BYTES: usize = 4096;

/// Counts the bytes that a decoder has taken.
pub(crate) struct Counted<R> {
    inner: R,
    n_read: u64,
    has_ended: bool,
    has_failed: bool,
}

impl<R> Counted<R> {
    fn new(inner: R) -> Self {
        Self { inner, n_read: 0, has_ended: false, has_failed: false }
    }
}

impl<R: BufRead> BufRead for Counted<R> {
    fn fill_buf(&mut self) -> io::Result<&[u8]> {
        match self.inner.fill_buf() {
            Ok(bytes) => {
                self.has_ended = bytes.is_empty();
                Ok(&bytes[..bytes.len().min(MAX_GIVEN_BYTES)])
            }
            Err(error) => {
                self.has_failed = error.kind() != io::ErrorKind::Interrupted;
                Err(error)
            }
        }
    }

    fn consume(&mut self, n_bytes: usize) {
        self.n_read += n_bytes as u64;
        self.inner.consume(n_bytes);
    }
}

impl<R: BufRead> Read for Counted<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let n_bytes = self.fill_buf()?.read(buffer)?;
        self.consume(n_bytes);
        Ok(n_bytes)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    fn text() -> Vec<u8> {
        (0..20_000).flat_map(|n: u32| format!("{} ", n.wrapping_mul(2_654_435_761)).into_bytes()).collect()
    }

    fn packed(text: &[u8]) -> [Vec<u8>; 2] {
        let mut gzip = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
        gzip.write_all(text).unwrap();
        [gzip.finish().unwrap(), zstd::bulk::compress(text, 3).unwrap()]
    }

    fn unpacked(n: usize, packed: impl BufRead) -> io::Result<Vec<u8>> {
        let mut reader =
            if n == 0 { Decompressed::gzip(packed) } else { Decompressed::zstd(packed, Some(23)).unwrap() };
        let mut text = Vec::new();
        reader.read_to_end(&mut text).map(|_| text)
    }

    #[test]
    fn what_ends_early_is_told_with_the_byte_at_which_it_ends() {
        for (n, packed) in packed(&text()).into_iter().enumerate() {
            assert_eq!(unpacked(n, &*packed).unwrap(), text());
            assert_eq!(unpacked(n, &*[&*packed, &*packed].concat()).unwrap().len(), 2 * text().len());
            for length in [5, 100, packed.len() / 2, packed.len() - 1] {
                let error = unpacked(n, &packed[..length]).unwrap_err();
                assert_eq!(error.to_string(), format!("compressed data ends early, at byte {length}"));
                assert_eq!(error.kind(), io::ErrorKind::InvalidData);
            }
        }
    }

    #[test]
    fn what_is_damaged_is_told_with_the_byte_by_which_that_was_noticed() {
        for (n, mut packed) in packed(&text()).into_iter().enumerate() {
            let at = packed.len() / 2;
            packed.iter_mut().skip(at).take(40).for_each(|byte| *byte = 0xff);
            let told = unpacked(n, &*packed).unwrap_err().to_string();
            let near = told.strip_prefix("compressed data is damaged near byte ").unwrap();
            let near: usize = near.split(':').next().unwrap().parse().unwrap();
            assert!(at <= near + MAX_GIVEN_BYTES && near <= packed.len(), "{at} of {}: {told}", packed.len());
        }
    }

    #[test]
    fn what_could_not_be_read_is_not_told_of_as_damaged() {
        struct Failing;
        impl Read for Failing {
            fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
                Err(io::Error::new(io::ErrorKind::TimedOut, "nothing comes"))
            }
        }
        for (n, packed) in packed(&text()).into_iter().enumerate() {
            let half = io::BufReader::new(packed[..packed.len() / 2].chain(Failing));
            let error = unpacked(n, half).unwrap_err();
            assert_eq!((error.kind(), &*error.to_string()), (io::ErrorKind::TimedOut, "nothing comes"));
        }
    }
}
