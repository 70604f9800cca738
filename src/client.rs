//! Clients: whom a task serves, and lines in which each of them has its turn.

use std::collections::VecDeque;
use std::net::{IpAddr, Ipv6Addr};

use rustc_hash::FxHashMap;

tokio::task_local! {
    static SERVED: Client;
}

/// Who takes turns with others: by address, until there are tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct Client(IpAddr);

impl Client {
    /// The service itself, and whoever uses it as a library.
    pub const LOCAL: Self = Self(IpAddr::V6(Ipv6Addr::UNSPECIFIED));

    /// Does `work` for this client, which is [`Self::served`] meanwhile.
    pub(crate) fn serve<T>(self, work: impl FnOnce() -> T) -> T {
        SERVED.sync_scope(self, work)
    }

    /// Whom the task that runs now serves; [`Self::LOCAL`] if it serves nobody in particular.
    pub(crate) fn served() -> Self {
        SERVED.try_with(|client| *client).unwrap_or(Self::LOCAL)
    }
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

/// What waits, in a line for each client. The first of each line has its turn before the second of any.
#[derive(Debug)]
pub(crate) struct Lines<T> {
    by_client: FxHashMap<Client, VecDeque<T>>,
    /// The clients that have a line, the next one first.
    order: VecDeque<Client>,
}

impl<T> Lines<T> {
    pub(crate) fn new() -> Self {
        Self { by_client: FxHashMap::default(), order: VecDeque::new() }
    }

    /// Whether nothing waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.order.is_empty()
    }

    /// Puts `waiting` at the end of the line of `client`.
    pub(crate) fn line_up(&mut self, client: Client, waiting: T) {
        let line = self.by_client.entry(client).or_default();
        if line.is_empty() {
            self.order.push_back(client);
        }
        line.push_back(waiting);
    }

    /// Takes out what is next.
    pub(crate) fn next(&mut self) -> Option<T> {
        let client = self.order.pop_front()?;
        let line = self.by_client.get_mut(&client)?;
        let next = line.pop_front();
        if line.is_empty() {
            self.by_client.remove(&client);
        } else {
            self.order.push_back(client);
        }
        next
    }
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

    #[test]
    fn clients_have_their_turns_one_after_the_other() {
        let client = |n: u8| Client::from(IpAddr::from([10, 0, 0, n]));
        let mut lines = Lines::new();
        for (n, waiting) in [(1, "a1"), (1, "a2"), (1, "a3"), (2, "b1"), (2, "b2"), (3, "c1")] {
            lines.line_up(client(n), waiting);
        }
        assert_eq!([lines.next(), lines.next()], [Some("a1"), Some("b1")]);
        // Who comes again goes behind those who wait.
        lines.line_up(client(4), "d1");
        let rest: Vec<&str> = std::iter::from_fn(|| lines.next()).collect();
        assert_eq!(rest, ["c1", "a2", "b2", "d1", "a3"]);
        assert!(lines.is_empty() && lines.by_client.is_empty());
    }

    #[test]
    fn whom_a_task_serves_is_known_while_it_is_served() {
        let client = Client::from(IpAddr::from([10, 0, 0, 1]));
        assert_eq!(
            (Client::served(), client.serve(Client::served), Client::served()),
            (Client::LOCAL, client, Client::LOCAL)
        );
    }
}
