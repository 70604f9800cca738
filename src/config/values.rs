//! Reading the values of flags.

use std::net::{SocketAddr, ToSocketAddrs};
use std::num::NonZeroUsize;
use std::path::PathBuf;
use std::time::Duration;

/// Least memory of a service: it keeps half of that for what it does not count.
const MIN_MEMORY_BYTES: u64 = 128 << 20;

/// Most threads: half of those that the runtime has for what blocks.
const MAX_THREADS: usize = 256;

/// Fewest connections, whatever the limits are.
pub(crate) const MIN_CONNECTIONS: usize = 16;

/// Most searches that wait, connections, and streams: beyond what memory and files allow.
const MAX_PLACES: usize = 1_000_000;

/// Reads an address to listen on: a host and a port.
pub(crate) fn parse_address(text: &str) -> Result<SocketAddr, String> {
    const EXPECTED: &str =
        "expected a host and a port, such as 127.0.0.1:8080, or 0.0.0.0:8080 for all of the machine's addresses";
    let Some((host, port)) = text.rsplit_once(':').filter(|(host, _)| !host.is_empty() && !host.contains('/')) else {
        return Err(EXPECTED.to_owned());
    };
    if port.parse::<u16>().is_err() {
        return Err(EXPECTED.to_owned());
    }
    // A name may have addresses of both kinds. Most clients try the older first.
    let addresses: Vec<SocketAddr> = match text.to_socket_addrs() {
        Ok(addresses) => addresses.collect(),
        Err(_) => return Err(format!("there is no host {host:?}; {EXPECTED}")),
    };
    let address = addresses.iter().find(|address| address.is_ipv4()).or(addresses.first());
    address.copied().ok_or_else(|| EXPECTED.to_owned())
}

/// Reads the path of a database.
pub(crate) fn parse_database(text: &str) -> Result<PathBuf, String> {
    if text.is_empty() {
        return Err("expected a file, such as etude.db".to_owned());
    }
    if text.starts_with(":memory:") {
        let detail = "the database is a file: for one that need not last, name a file in a temporary directory, such as /tmp/etude.db";
        return Err(detail.to_owned());
    }
    if let Some(file) = text.strip_prefix("sqlite:") {
        let file = file.trim_start_matches("//");
        return Err(format!("expected a file, not a URL: {file}"));
    }
    Ok(text.into())
}

fn parse_at_most(text: &str, most: usize) -> Result<usize, String> {
    let count = parse_whole(text)?;
    if count <= most { Ok(count) } else { Err(format!("expected at most {most}")) }
}

/// Reads a number of places, which may be 0.
pub(super) fn parse_places(text: &str) -> Result<usize, String> {
    parse_at_most(text, MAX_PLACES)
}

/// Reads a number of connections.
pub(super) fn parse_connections(text: &str) -> Result<usize, String> {
    let count = parse_places(text)?;
    if count >= MIN_CONNECTIONS { Ok(count) } else { Err(format!("expected at least {MIN_CONNECTIONS}")) }
}

/// Reads a number of threads.
pub(super) fn parse_threads(text: &str) -> Result<NonZeroUsize, String> {
    NonZeroUsize::new(parse_at_most(text, MAX_THREADS)?).ok_or_else(|| "expected at least 1".to_owned())
}

/// Reads a whole number that is not negative.
pub(crate) fn parse_whole<T: TryFrom<u64>>(text: &str) -> Result<T, String> {
    const EXPECTED: &str = "expected a whole number of at least 0, such as 1000";
    if text.is_empty() || !text.bytes().all(|digit| digit.is_ascii_digit()) {
        return Err(EXPECTED.to_owned());
    }
    let number = text.parse().ok().and_then(|number: u64| number.try_into().ok());
    number.ok_or_else(|| "expected a smaller number".to_owned())
}

/// Reads a whole number above 0.
pub(crate) fn parse_count(text: &str) -> Result<usize, String> {
    parse_whole(text).and_then(|count| if count > 0 { Ok(count) } else { Err("expected at least 1".to_owned()) })
}

/// Reads an amount of memory that a service can do with.
pub(super) fn parse_memory(text: &str) -> Result<u64, String> {
    let n_bytes = parse_bytes(text)?;
    if n_bytes >= MIN_MEMORY_BYTES { Ok(n_bytes) } else { Err("expected at least 128M".to_owned()) }
}

/// Reads a number of bytes, such as 800000000, 512M or 2G (2^20 and 2^30 bytes).
pub(super) fn parse_bytes<T: TryFrom<u64>>(text: &str) -> Result<T, String> {
    const UNITS: [(char, u64); 3] = [('K', 1 << 10), ('M', 1 << 20), ('G', 1 << 30)];
    let number = text.strip_suffix("iB").unwrap_or(text);
    let with_unit = UNITS.iter().find_map(|(letter, unit)| Some((number.strip_suffix(*letter)?, *unit)));
    let (digits, unit) = with_unit.unwrap_or((number, 1));
    let n_bytes = digits.parse::<u64>().ok().and_then(|count| count.checked_mul(unit));
    let n_bytes = n_bytes.and_then(|n_bytes| n_bytes.try_into().ok());
    n_bytes.ok_or_else(|| "expected a number of bytes, such as 800000000, 512M or 2G".to_owned())
}

/// Reads a time, which may be 0.
pub(super) fn parse_duration(text: &str) -> Result<Duration, String> {
    let duration: Option<jiff::SignedDuration> = text.parse().ok();
    let duration = duration.and_then(|duration| Duration::try_from(duration).ok());
    duration.ok_or_else(|| "expected a time with its unit, such as 500ms, 10s or 1m".to_owned())
}

/// Reads a time above 0.
pub(super) fn parse_period(text: &str) -> Result<Duration, String> {
    parse_duration(text)
        .and_then(|period| if period.is_zero() { Err("expected a time above 0".to_owned()) } else { Ok(period) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_a_host_and_a_port() {
        for text in ["127.0.0.1:8080", "localhost:8080"] {
            assert_eq!(parse_address(text), Ok(SocketAddr::from(([127, 0, 0, 1], 8080))), "{text}");
        }
        assert_eq!(parse_address("[::1]:0"), Ok(SocketAddr::from(([0, 0, 0, 0, 0, 0, 0, 1], 0))));
        for text in
            ["8080", ":8080", "localhost", "localhost:", "localhost:port", "localhost:65536", "http://127.0.0.1:8080"]
        {
            assert!(parse_address(text).unwrap_err().starts_with("expected a host and a port"), "{text}");
        }
    }

    #[test]
    fn a_database_is_a_file() {
        assert_eq!(parse_database("data/etude.db"), Ok("data/etude.db".into()));
        for text in ["", ":memory:", "sqlite://etude.db", "sqlite::memory:"] {
            assert!(parse_database(text).is_err(), "{text}");
        }
    }

    #[test]
    fn times_are_written_with_their_unit() {
        assert_eq!(parse_duration("1s"), Ok(Duration::from_secs(1)));
        assert_eq!(parse_duration("500ms"), Ok(Duration::from_millis(500)));
        assert!(parse_duration("-1s").is_err() && parse_duration("7").is_err());
    }

    #[test]
    fn memory_is_written_in_bytes_or_with_a_unit() {
        assert_eq!((parse_memory("134217728"), parse_memory("2G")), (Ok(128 << 20), Ok(2 << 30)));
        assert_eq!((parse_memory("512M"), parse_memory("512MiB")), (Ok(512 << 20), Ok(512 << 20)));
        for text in ["", "G", "1.5G", "-1", "127M", "99999999999G", "2T"] {
            assert!(parse_memory(text).is_err(), "{text}");
        }
    }

    #[test]
    fn more_places_than_there_can_be_are_refused() {
        assert_eq!((parse_places("0"), parse_places("1000000")), (Ok(0), Ok(MAX_PLACES)));
        assert!(parse_connections("15").is_err() && parse_connections("1000001").is_err());
        assert!(parse_places("1000001").is_err() && parse_places("18446744073709551615").is_err());
        assert!(parse_threads("256").is_ok() && parse_threads("257").is_err() && parse_threads("0").is_err());
    }
}
