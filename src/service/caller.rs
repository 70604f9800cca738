//! Who asks for something, and since when.

use std::net::{IpAddr, Ipv6Addr};
use std::time::Instant;

use jiff::Timestamp;

/// Who takes turns with others: by address, until there are tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Client(IpAddr);

impl Client {
    /// The service itself, and whoever uses it as a library.
    pub const LOCAL: Self = Self(IpAddr::V6(Ipv6Addr::UNSPECIFIED));
}

impl From<IpAddr> for Client {
    fn from(address: IpAddr) -> Self {
        match address.to_canonical() {
            v4 @ IpAddr::V4(_) => Self(v4),
            // One host has as many addresses of its network as it likes.
            IpAddr::V6(v6) => {
                let [a, b, c, d, ..] = v6.segments();
                Self(Ipv6Addr::new(a, b, c, d, 0, 0, 0, 1).into())
            }
        }
    }
}

/// A request's caller.
#[derive(Clone, Copy, Debug)]
pub struct Caller {
    /// Who asks.
    pub client: Client,
    /// When the request arrived: what deadlines count from.
    pub arrived: Instant,
    /// The same moment on the calendar.
    pub now: Timestamp,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_client_is_an_address_or_a_network_of_ipv6() {
        let client = |text: &str| Client::from(text.parse::<IpAddr>().unwrap());
        assert_eq!(client("127.0.0.1"), client("::ffff:127.0.0.1"));
        assert_ne!(client("127.0.0.1"), client("127.0.0.2"));
        assert_eq!(client("2001:db8::1"), client("2001:db8::2"));
        assert_ne!(client("2001:db8::1"), client("2001:db8:0:1::1"));
        assert_ne!(client("::"), Client::LOCAL);
    }
}
