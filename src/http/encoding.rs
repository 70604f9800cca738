//! Bodies that were compressed.

use std::io::{self, BufRead, BufReader, Read};

use axum::http::HeaderMap;
use axum::http::header::CONTENT_ENCODING;

use crate::compressed::Decompressed;
use crate::memory::NoRoom;

/// How a body was compressed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Encoding {
    Identity,
    Gzip,
    Zstd,
}

impl Encoding {
    /// What a client may send, as `Accept-Encoding` says it.
    pub(super) const ACCEPTED: &str = "gzip, zstd";

    /// Largest window of a zstd frame, as a power of two: 8 MiB, as RFC 9659 has it for HTTP. A decoder keeps as much.
    const MAX_WINDOW_LOG: u32 = 23;

    /// Most bytes that a decoder looks back at.
    pub(super) const MAX_WINDOW_BYTES: usize = 1 << Self::MAX_WINDOW_LOG;

    /// The encoding that is declared; the declaration, if it is none of the accepted ones.
    pub(super) fn declared(headers: &HeaderMap) -> Result<Self, String> {
        let mut declared = headers.get_all(CONTENT_ENCODING).iter();
        let (Some(first), None) = (declared.next(), declared.next()) else {
            let count = headers.get_all(CONTENT_ENCODING).iter().count();
            return if count == 0 { Ok(Self::Identity) } else { Err("several encodings".to_owned()) };
        };
        match first.to_str().unwrap_or_default().trim().to_ascii_lowercase().as_str() {
            "identity" => Ok(Self::Identity),
            "gzip" | "x-gzip" => Ok(Self::Gzip),
            "zstd" => Ok(Self::Zstd),
            other => Err(other.to_owned()),
        }
    }

    /// Decompresses `body`, of which at most `limit` bytes come out.
    pub(super) fn decode<R: BufRead + Send + 'static>(
        self,
        body: R,
        limit: DecodedLimit,
    ) -> io::Result<Box<dyn BufRead + Send>> {
        let decoded: Box<dyn Read + Send> = match self {
            Self::Identity => {
                return Ok(Box::new(BufReader::new(Limited { inner: body, n_left: limit.n_bytes, limit })));
            }
            Self::Gzip => Box::new(Decompressed::gzip(body)),
            Self::Zstd => Box::new(Decompressed::zstd(body, Some(Self::MAX_WINDOW_LOG))?),
        };
        Ok(Box::new(BufReader::with_capacity(1 << 16, Limited { inner: decoded, n_left: limit.n_bytes, limit })))
    }
}

/// Most bytes of a body once it is decompressed, and what the setting is called.
#[derive(Clone, Copy, Debug)]
pub(super) struct DecodedLimit {
    pub(super) n_bytes: u64,
    pub(super) setting: &'static str,
}

/// Why a body could not be read to its end. Travels within an [`io::Error`].
#[derive(Debug, thiserror::Error)]
pub(super) enum BodyError {
    #[error("the connection ended within the body")]
    Incomplete,
    #[error("{0}")]
    TooLarge(String),
    #[error("{0}")]
    Slow(String),
    #[error(transparent)]
    NoRoom(NoRoom),
    #[error("{0}")]
    Broken(String),
}

impl From<BodyError> for io::Error {
    fn from(error: BodyError) -> Self {
        Self::other(error)
    }
}

/// Fails where the inner reader has more than the limit.
struct Limited<R> {
    inner: R,
    n_left: u64,
    limit: DecodedLimit,
}

impl<R: Read> Read for Limited<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        // Whoever reads it might take what cannot be decompressed for a file that is compressed within the body.
        let broken = |error: io::Error| match error.kind() {
            io::ErrorKind::InvalidData => BodyError::Broken(error.to_string()).into(),
            _ => error,
        };
        let n_read = self.inner.read(buffer).map_err(broken)?;
        self.n_left = self.n_left.checked_sub(n_read as u64).ok_or_else(|| {
            let DecodedLimit { n_bytes, setting } = self.limit;
            BodyError::TooLarge(format!(
                "the body has over {n_bytes} bytes once it is decompressed, the limit of this service ({setting})"
            ))
        })?;
        Ok(n_read)
    }
}
