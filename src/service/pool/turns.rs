//! Whose turn it is to use a thread: the policy of the pool, without threads or clocks.
//!
//! A job is *short* until it has run for a moment, and *long* from then on. A short one of a client that has used processors little of late is
//! *quick*: there are threads for such jobs alone.
//!
//! - Short jobs come before long ones. Long ones have all threads but one and those that only short ones use; one more is lent to
//!   them while nothing short comes.
//! - Of jobs of a kind, those of the client that has used processors least of late are next ([`Usage`]). Of a client's jobs, the one that
//!   has run least is served first (a level is twice as long as the one before it), and of those the first to come.
//! - A long job makes way if the next one has run less, or is another client's and it had its share.
//! - A client may have at most as many places as are left free for others: one client leaves at least half of all places free, two leave
//!   a quarter.

mod usage;

use std::collections::{BTreeSet, VecDeque};
use std::time::{Duration, Instant};

use rustc_hash::FxHashMap;

use crate::client::Client;
use usage::Usage;

/// Threads that only short jobs use. There is more than one, as a short job may run longer than it should before it is noticed.
const N_SHORT_THREADS: usize = 2;

/// How long nothing short must have come before another thread is lent to long jobs.
pub(super) const LENT_AFTER: Duration = Duration::from_millis(10);

/// A client that has used less than this of late uses little: a few hundredths of a processor, if it goes on like that.
const LITTLE_SECONDS: f64 = 0.05;

/// How long a job has run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Class {
    /// Less than a moment, for a client that uses little. A job is so only while it runs; where it waits it is short.
    Quick,
    /// Less than a moment.
    Short,
    /// Longer.
    Long,
}

/// How long a job has run, as the power of two of how many moments: 0 for short ones.
pub(super) type Level = u32;

/// A job that waits for a thread.
pub(super) type Ticket = u64;

/// Threads and places, who has them, and who waits for a thread.
#[derive(Debug)]
pub(super) struct Turns {
    /// All threads.
    n_threads: usize,
    /// Those that long jobs may have; one less while short ones come.
    n_long_threads: usize,
    /// Jobs that have a thread, without the quick ones.
    n_running: usize,
    n_quick: usize,
    /// Whose long jobs run.
    running_long: Vec<Client>,
    short: Places,
    long: Places,
    waiting_short: Queue,
    waiting_long: Queue,
    next_ticket: Ticket,
    usage: Usage,
    /// When something short last came.
    last_short: Option<Instant>,
}

impl Turns {
    /// Turns for `n_threads` and a few more for what is short, and for so many short and so many long jobs, waiting or running.
    pub(super) fn new(n_threads: usize, n_short: usize, n_long: usize) -> Self {
        Self {
            n_threads: n_threads + N_SHORT_THREADS,
            n_long_threads: n_threads,
            n_running: 0,
            n_quick: 0,
            running_long: Vec::new(),
            short: Places::new(n_short),
            long: Places::new(n_long),
            waiting_short: Queue::default(),
            waiting_long: Queue::default(),
            next_ticket: 0,
            usage: Usage::default(),
            last_short: None,
        }
    }

    /// How many jobs have a place.
    pub(super) fn n_jobs(&self) -> usize {
        self.short.n_taken + self.long.n_taken
    }

    /// How many jobs that have a place are long.
    #[cfg(test)]
    pub(super) fn n_long(&self) -> usize {
        self.long.n_taken
    }

    /// How many jobs have a thread.
    pub(super) fn n_running(&self) -> usize {
        self.n_running + self.n_quick
    }

    /// How many threads there are, with those for what is quick.
    #[cfg(test)]
    pub(super) fn n_all(&self) -> usize {
        self.n_threads + self.n_long_threads
    }

    /// Gives `client` a place among the jobs of a class, if there is one for it.
    pub(super) fn admit(&mut self, client: Client, class: Class) -> bool {
        self.places(class).take(client)
    }

    /// Takes a place back.
    pub(super) fn leave(&mut self, client: Client, class: Class) {
        self.places(class).give_back(client);
    }

    /// Notes that a short job came at `now`, whether it needs a thread or not.
    pub(super) fn note_short(&mut self, now: Instant) {
        self.last_short = self.last_short.max(Some(now));
    }

    /// Notes that `client` has used a processor for so long, until `now`.
    pub(super) fn charge(&mut self, client: Client, used: Duration, now: Instant) {
        self.usage.add(client, used, now);
    }

    /// Takes a thread at `now`, if there is one for a job of this class and nobody waits for it. Says what the job is then.
    pub(super) fn try_start(&mut self, client: Client, class: Class, now: Instant) -> Option<Class> {
        if class == Class::Short {
            self.note_short(now);
            if self.may_be_quick(client, now) {
                return Some(self.start(client, Class::Quick));
            }
        }
        let is_first = self.waiting_short.is_empty() && (class == Class::Short || self.waiting_long.is_empty());
        (is_first && self.has_thread_for(class, now)).then(|| self.start(client, class))
    }

    /// Takes a thread for a job that nobody waits for, if another one stays free and nobody waits.
    pub(super) fn try_start_spare(&mut self, client: Client) -> bool {
        let starts = self.n_running() + 1 < self.n_long_threads.max(2) && !self.is_waited_for();
        if starts {
            self.start(client, Class::Long);
        }
        starts
    }

    /// Lines up for a thread.
    pub(super) fn wait(&mut self, client: Client, class: Class, level: Level) -> Ticket {
        self.next_ticket += 1;
        let ticket = self.next_ticket;
        self.queue(class).push(client, (level, ticket));
        ticket
    }

    /// Gives up waiting. Says whether the job still waited; if not, it has its thread.
    pub(super) fn give_up(&mut self, client: Client, class: Class, ticket: Ticket) -> bool {
        self.queue(class).remove(client, ticket)
    }

    /// A job of this class needs its thread no longer.
    pub(super) fn stop(&mut self, client: Client, class: Class) {
        let n_running = if class == Class::Quick { &mut self.n_quick } else { &mut self.n_running };
        *n_running -= 1;
        if class == Class::Long
            && let Some(at) = self.running_long.iter().position(|running| *running == client)
        {
            self.running_long.swap_remove(at);
        }
    }

    /// The next job whose turn it is, which has a thread now, and what it is then; nothing if none waits, or there is no thread for it.
    pub(super) fn next(&mut self, now: Instant) -> Option<(Ticket, Class)> {
        let next = self.waiting_short.first(&self.usage, now);
        let (class, client) = match next {
            Some(client) if self.may_be_quick(client, now) => (Class::Quick, client),
            Some(client) if self.has_thread_for(Class::Short, now) => (Class::Short, client),
            _ if self.has_thread_for(Class::Long, now) => (Class::Long, self.waiting_long.first(&self.usage, now)?),
            _ => return None,
        };
        let ticket = self.queue(class).pop(client)?;
        Some((ticket, self.start(client, class)))
    }

    /// A running job of `client`, of this class until now, has become long. Says whether it may keep its thread.
    pub(super) fn become_long(&mut self, client: Client, class: Class, now: Instant) -> bool {
        self.stop(client, class);
        self.start(client, Class::Long);
        !self.is_one_too_many(client, now)
    }

    /// Whether a long job that runs should make way.
    pub(super) fn makes_way(&self, client: Client, level: Level, had_its_share: bool, now: Instant) -> bool {
        self.is_one_too_many(client, now)
            || self.waiting_long.first(&self.usage, now).is_some_and(|next| {
                let is_less = self.waiting_long.least_level(next).is_some_and(|least| least < level);
                let may_come = next == client || self.usage.of(next, now) <= self.usage.of(client, now);
                may_come && (is_less || (had_its_share && next != client))
            })
    }

    /// Whether anybody waits for a thread.
    pub(super) fn is_waited_for(&self) -> bool {
        !(self.waiting_short.is_empty() && self.waiting_long.is_empty())
    }

    /// Whether as many threads are taken as there are processors for.
    pub(super) fn are_all_taken(&self) -> bool {
        self.n_running() >= self.n_long_threads.max(2)
    }

    /// Whether more long jobs run than may, and this one of `client` is to make way. That is up to the client that has used processors most, which
    /// may take a while to see it: until then, there is one more.
    fn is_one_too_many(&self, client: Client, now: Instant) -> bool {
        let n_beyond = self.running_long.len().saturating_sub(self.n_for_long(now));
        let used = self.usage.of(client, now);
        let has_used_more = |other: &Client| self.usage.of(*other, now) > used;
        n_beyond > 1 || (n_beyond == 1 && !self.running_long.iter().any(has_used_more))
    }

    /// How many threads long jobs may have.
    fn n_for_long(&self, now: Instant) -> usize {
        let is_quiet = self.last_short.is_none_or(|last| now.saturating_duration_since(last) >= LENT_AFTER);
        let is_lent = is_quiet && self.waiting_short.is_empty();
        if is_lent { self.n_long_threads } else { self.n_long_threads - 1 }.max(1)
    }

    fn has_thread_for(&self, class: Class, now: Instant) -> bool {
        let is_free = self.n_running < self.n_threads;
        is_free && (class == Class::Short || self.running_long.len() < self.n_for_long(now))
    }

    /// Whether a short job of `client` would have a thread for quick ones.
    fn may_be_quick(&self, client: Client, now: Instant) -> bool {
        self.n_quick < self.n_long_threads && self.usage.of(client, now) < LITTLE_SECONDS
    }

    /// Takes a thread.
    fn start(&mut self, client: Client, class: Class) -> Class {
        match class {
            Class::Quick => self.n_quick += 1,
            Class::Short => self.n_running += 1,
            Class::Long => {
                self.n_running += 1;
                self.running_long.push(client);
            }
        }
        class
    }

    fn places(&mut self, class: Class) -> &mut Places {
        match class {
            Class::Quick | Class::Short => &mut self.short,
            Class::Long => &mut self.long,
        }
    }

    fn queue(&mut self, class: Class) -> &mut Queue {
        match class {
            Class::Quick | Class::Short => &mut self.waiting_short,
            Class::Long => &mut self.waiting_long,
        }
    }
}

/// Places, and how many of them each client has.
#[derive(Debug)]
pub(crate) struct Places {
    n_all: usize,
    n_taken: usize,
    by_client: FxHashMap<Client, usize>,
}

impl Places {
    pub(crate) fn new(n_all: usize) -> Self {
        Self { n_all, n_taken: 0, by_client: FxHashMap::default() }
    }

    /// Gives `client` a place, if there is one for it.
    pub(crate) fn take(&mut self, client: Client) -> bool {
        let n_free = self.n_all - self.n_taken;
        let own = self.by_client.entry(client).or_default();
        let is_admitted = n_free > 0 && *own <= n_free;
        if is_admitted {
            *own += 1;
            self.n_taken += 1;
        } else if *own == 0 {
            self.by_client.remove(&client);
        }
        is_admitted
    }

    /// Takes a place back.
    pub(crate) fn give_back(&mut self, client: Client) {
        self.n_taken -= 1;
        if let Some(own) = self.by_client.get_mut(&client) {
            *own -= 1;
            if *own == 0 {
                self.by_client.remove(&client);
            }
        }
    }
}

/// Jobs that wait, by client.
#[derive(Debug, Default)]
struct Queue {
    /// Those of whom jobs wait, in the order of their turns.
    turns: VecDeque<Client>,
    /// In the order in which they are served; never empty.
    jobs: FxHashMap<Client, BTreeSet<(Level, Ticket)>>,
}

impl Queue {
    fn is_empty(&self) -> bool {
        self.turns.is_empty()
    }

    /// The client that is next: of those that have used processors least, the one that has waited longest for its turn.
    fn first(&self, usage: &Usage, now: Instant) -> Option<Client> {
        let used = |client: &Client| usage.of(*client, now);
        self.turns.iter().copied().min_by(|a, b| used(a).total_cmp(&used(b)))
    }

    /// The level of the client's job that has run least.
    fn least_level(&self, client: Client) -> Option<Level> {
        Some(self.jobs.get(&client)?.first()?.0)
    }

    fn push(&mut self, client: Client, job: (Level, Ticket)) {
        let jobs = self.jobs.entry(client).or_default();
        if jobs.is_empty() {
            self.turns.push_back(client);
        }
        jobs.insert(job);
    }

    /// Takes out the client's job that is next. The client goes to the end of the line.
    fn pop(&mut self, client: Client) -> Option<Ticket> {
        let jobs = self.jobs.get_mut(&client)?;
        let next = jobs.pop_first();
        self.turns.retain(|waiting| *waiting != client);
        if jobs.is_empty() {
            self.jobs.remove(&client);
        } else {
            self.turns.push_back(client);
        }
        next.map(|(_, ticket)| ticket)
    }

    fn remove(&mut self, client: Client, ticket: Ticket) -> bool {
        let Some(jobs) = self.jobs.get_mut(&client) else { return false };
        let n_before = jobs.len();
        jobs.retain(|(_, waiting)| *waiting != ticket);
        let is_removed = jobs.len() < n_before;
        if jobs.is_empty() {
            self.jobs.remove(&client);
            self.turns.retain(|waiting| *waiting != client);
        }
        is_removed
    }
}

#[cfg(test)]
mod tests;
