//! Places for connections: how many there are, who has one, and who makes room.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::time::Instant;

use super::stalled::Watcher;
use crate::client::Client;
use crate::clock::timer_now;

/// Most connections that are examined to find one that makes room. It bounds the work for a newcomer when all places are taken.
const MAX_LOOKED_AT: usize = 1024;

/// How much longer than others a stream is waited for: it has timeouts of its own, and says goodbye after those.
const STREAM_GRACE: Duration = Duration::from_secs(15);

/// All places.
#[derive(Debug)]
pub(super) struct Places {
    table: Mutex<Table>,
    max: usize,
    /// Most places of one client.
    max_each: usize,
    opened: Instant,
}

#[derive(Debug, Default)]
struct Table {
    slots: Vec<Option<Taken>>,
    /// Slots of `slots` that nobody has.
    free: Vec<usize>,
    n_by_client: HashMap<Client, usize>,
    n_entered: u64,
    /// Where to look next for one that makes room.
    cursor: usize,
}

/// A place that somebody has.
#[derive(Debug)]
struct Taken {
    /// No two connections have the same.
    number: u64,
    client: Client,
    activity: Arc<Activity>,
    /// Dropped to end the connection.
    _end: oneshot::Sender<()>,
}

impl Places {
    /// `max` places, of which one client may have three quarters.
    pub(super) fn new(max: usize) -> Self {
        Self { table: Mutex::default(), max, max_each: (max - max / 4).max(1), opened: timer_now() }
    }

    /// A place for a connection of `client`, and what hears of its end; `None` if all are taken and nobody makes room. Who has
    /// as many as one may have makes room for itself.
    pub(super) fn enter(self: &Arc<Self>, client: Client) -> Option<(ConnectionPlace, oneshot::Receiver<()>)> {
        let mut table = self.table();
        if table.n_by_client.get(&client).is_some_and(|n_taken| *n_taken >= self.max_each) {
            table.make_room(Some(client)).then_some(())?;
        } else if table.n_taken() >= self.max {
            table.make_room(None).then_some(())?;
        }
        let activity = Arc::new(Activity::of(self.opened));
        let (end, ended) = oneshot::channel();
        table.n_entered += 1;
        let number = table.n_entered;
        let taken = Taken { number, client, activity: Arc::clone(&activity), _end: end };
        let slot = if let Some(slot) = table.free.pop() {
            table.slots[slot] = Some(taken);
            slot
        } else {
            table.slots.push(Some(taken));
            table.slots.len() - 1
        };
        *table.n_by_client.entry(client).or_default() += 1;
        metrics::gauge!("etude_connections").increment(1);
        Some((ConnectionPlace { places: Arc::clone(self), slot, number, activity }, ended))
    }

    /// Ends the connection that has been without a request longest, if there is one.
    pub(super) fn make_room(&self) {
        self.table().make_room(None);
    }

    /// Ends all connections, once what runs on them has ended.
    pub(super) fn end_all(&self) {
        let mut table = self.table();
        for slot in 0..table.slots.len() {
            table.leave(slot);
        }
    }

    /// How many are taken.
    pub(super) fn n_taken(&self) -> usize {
        self.table().n_taken()
    }

    fn table(&self) -> MutexGuard<'_, Table> {
        self.table.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Table {
    fn n_taken(&self) -> usize {
        self.slots.len() - self.free.len()
    }

    /// Takes the place of the connection that has been without a request longest, of those that are looked at.
    fn make_room(&mut self, of: Option<Client>) -> bool {
        let n_slots = self.slots.len();
        let looked_at = (0..n_slots.min(MAX_LOOKED_AT)).map(|n| (self.cursor + n) % n_slots);
        let idle = looked_at.filter_map(|slot| {
            let taken = self.slots[slot].as_ref().filter(|taken| of.is_none_or(|of| of == taken.client))?;
            Some((taken.activity.idle_since()?, slot))
        });
        let longest = idle.min();
        self.cursor = (self.cursor + MAX_LOOKED_AT) % n_slots.max(1);
        let Some((since, slot)) = longest else { return false };
        // Unless a request has just come.
        let makes_room = self.slots[slot].as_ref().is_some_and(|taken| taken.activity.make_room(since));
        if makes_room {
            self.leave(slot);
        }
        makes_room
    }

    fn leave(&mut self, slot: usize) {
        let Some(taken) = self.slots[slot].take() else { return };
        self.free.push(slot);
        if let Entry::Occupied(mut n_taken) = self.n_by_client.entry(taken.client) {
            *n_taken.get_mut() -= 1;
            if *n_taken.get() == 0 {
                n_taken.remove();
            }
        }
        metrics::gauge!("etude_connections").decrement(1);
    }
}

/// A connection's place, until this is dropped.
#[derive(Debug)]
pub(super) struct ConnectionPlace {
    places: Arc<Places>,
    slot: usize,
    number: u64,
    activity: Arc<Activity>,
}

impl ConnectionPlace {
    /// What the connection does.
    pub(super) fn activity(&self) -> &Arc<Activity> {
        &self.activity
    }
}

impl Drop for ConnectionPlace {
    fn drop(&mut self) {
        let mut table = self.places.table();
        // Another may have it already.
        if table.slots[self.slot].as_ref().is_some_and(|taken| taken.number == self.number) {
            table.leave(self.slot);
        }
    }
}

impl Watcher for ConnectionPlace {
    fn is_writing(&self, is_writing: bool) {
        self.activity.is_writing.store(is_writing, Ordering::Relaxed);
    }

    fn grace(&self) -> Duration {
        if self.activity.is_stream.load(Ordering::Relaxed) { STREAM_GRACE } else { Duration::ZERO }
    }
}

/// What a connection does, for those who look for one that may make room.
#[derive(Debug)]
pub(super) struct Activity {
    /// [`Self::BUSY`], [`Self::MAKES_ROOM`], or since when it has been without a request, in nanoseconds.
    state: AtomicU64,
    /// Whether writing waits for the client.
    is_writing: AtomicBool,
    is_stream: AtomicBool,
    /// When times began.
    opened: Instant,
}

impl Activity {
    const BUSY: u64 = u64::MAX;
    const MAKES_ROOM: u64 = u64::MAX - 1;

    fn of(opened: Instant) -> Self {
        Self {
            state: AtomicU64::new(Self::since(opened)),
            is_writing: AtomicBool::new(false),
            is_stream: AtomicBool::new(false),
            opened,
        }
    }

    fn since(opened: Instant) -> u64 {
        u64::try_from(opened.elapsed().as_nanos()).unwrap_or(Self::MAKES_ROOM - 1)
    }

    /// A request begins; `None` if the connection makes room.
    pub(super) fn begin(activity: &Arc<Self>) -> Option<Busy> {
        let begun = activity.state.fetch_update(Ordering::AcqRel, Ordering::Acquire, |state| {
            (state != Self::MAKES_ROOM).then_some(Self::BUSY)
        });
        begun.ok().map(|_| Busy(Some(Arc::clone(activity))))
    }

    /// Whether the connection has lost its place.
    pub(super) fn makes_room(&self) -> bool {
        self.state.load(Ordering::Acquire) == Self::MAKES_ROOM
    }

    /// Whether writing waits for the client.
    pub(super) fn is_writing(&self) -> bool {
        self.is_writing.load(Ordering::Relaxed)
    }

    fn idle_since(&self) -> Option<u64> {
        let state = self.state.load(Ordering::Acquire);
        (state < Self::MAKES_ROOM && !self.is_writing()).then_some(state)
    }

    fn make_room(&self, since: u64) -> bool {
        self.state.compare_exchange(since, Self::MAKES_ROOM, Ordering::AcqRel, Ordering::Acquire).is_ok()
    }
}

/// A connection is busy with a request until this is dropped.
#[derive(Debug)]
pub(super) struct Busy(Option<Arc<Activity>>);

impl Busy {
    /// The answer is a stream.
    pub(super) fn is_stream(&self) {
        if let Some(activity) = &self.0 {
            activity.is_stream.store(true, Ordering::Relaxed);
        }
    }

    /// The connection stays busy until it ends.
    pub(super) fn for_ever(mut self) {
        self.0 = None;
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        if let Some(activity) = &self.0 {
            activity.state.store(Activity::since(activity.opened), Ordering::Release);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::{IpAddr, Ipv4Addr};

    use super::*;

    fn client(n: u8) -> Client {
        Client::from(IpAddr::V4(Ipv4Addr::new(10, 0, 0, n)))
    }

    /// Enters at a moment of its own.
    async fn enter(places: &Arc<Places>, n: u8) -> Option<(ConnectionPlace, oneshot::Receiver<()>)> {
        tokio::time::advance(std::time::Duration::from_millis(1)).await;
        places.enter(client(n))
    }

    fn has_ended(end: &mut oneshot::Receiver<()>) -> bool {
        end.try_recv() == Err(oneshot::error::TryRecvError::Closed)
    }

    #[tokio::test(start_paused = true)]
    async fn who_has_been_without_a_request_longest_makes_room() {
        let places = Arc::new(Places::new(4));
        let mut taken = Vec::new();
        for n in 0..4 {
            taken.push(enter(&places, n).await.unwrap());
        }
        // The first one has answered a request since, the second is at it.
        drop(Activity::begin(taken[0].0.activity()));
        let busy = Activity::begin(taken[1].0.activity());
        let (fifth, _end) = enter(&places, 4).await.unwrap();
        let ended: Vec<bool> = taken.iter_mut().map(|(_, end)| has_ended(end)).collect();
        assert_eq!(ended, [false, false, true, false]);
        assert!(taken[2].0.activity().makes_room() && Activity::begin(taken[2].0.activity()).is_none());
        assert_eq!(places.n_taken(), 4);
        // Its place is not given back twice.
        taken.remove(2);
        assert_eq!(places.n_taken(), 4);
        // Who is being answered keeps its place, as who has a request does.
        taken[2].0.is_writing(true);
        let busy = [busy, Activity::begin(taken[0].0.activity()), Activity::begin(fifth.activity())];
        assert!(enter(&places, 5).await.is_none());
        taken[2].0.is_writing(false);
        assert!(enter(&places, 5).await.is_some());
        drop(busy);
    }

    #[tokio::test(start_paused = true)]
    async fn one_client_has_three_quarters_at_most_and_makes_room_for_itself() {
        let places = Arc::new(Places::new(8));
        let mut other = enter(&places, 2).await.unwrap();
        let mut own = Vec::new();
        for _ in 0..7 {
            own.push(enter(&places, 1).await.unwrap());
        }
        assert_eq!(places.n_taken(), 7);
        assert!(has_ended(&mut own[0].1) && !has_ended(&mut other.1));
        let busy: Vec<_> = own.iter().map(|(place, _)| Activity::begin(place.activity())).collect();
        assert!(enter(&places, 1).await.is_none());
        assert!(enter(&places, 2).await.is_some());
        drop(busy);
    }

    #[tokio::test(start_paused = true)]
    async fn a_place_is_taken_until_the_connection_ends() {
        let places = Arc::new(Places::new(2));
        let (first, _end) = enter(&places, 1).await.unwrap();
        Activity::begin(first.activity()).unwrap().for_ever();
        let (second, _end) = enter(&places, 2).await.unwrap();
        Activity::begin(second.activity()).unwrap().for_ever();
        assert!(enter(&places, 3).await.is_none());
        drop(first);
        assert!(enter(&places, 3).await.is_some());
    }
}
