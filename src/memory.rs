//! The one budget of memory, from which everything large takes what it uses.
//!
//! ```text
//! --max-memory = base (connections, caches of SQLite, small requests) + room
//!                                                                       ^
//!                models, searches, batches, bodies, answers, streams ---+  take() and give back
//! ```
//!
//! Whoever is about to use much memory takes so many bytes first, and gives them back by dropping what it holds. What does not fit
//! waits ([`Memory::take`]) or is refused ([`Memory::try_take`]). An eighth of the room is left to what takes up to [`SMALL_BYTES`], so that
//! large requests cannot keep small ones from being answered.
//!
//! The budget counts only what is taken from it. Other memory shows in what is resident, which [`Memory::watch`] measures: while most of
//! `--max-memory` is resident, nothing large is begun, whatever was counted.

use std::fs::{self, File};
use std::os::unix::fs::FileExt;
use std::pin::pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::sync::{Notify, OwnedSemaphorePermit, Semaphore};

/// Memory is taken in units of this size, of which there can be 2^32.
const UNIT_BYTES: u64 = 4096;

/// Most that is small, for which an eighth of the room is kept.
pub const SMALL_BYTES: u64 = 1 << 20;

/// Most that need not be counted at all.
pub const UNCOUNTED_BYTES: u64 = 64 << 10;

/// There is no room for so much now; or there never is, if it is more than all the room.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{wanted} bytes do not fit into the memory of this service (ETUDE_MAX_MEMORY), which has {room} for requests")]
pub struct NoRoom {
    /// How much was wanted, in bytes.
    pub wanted: u64,
    /// How much there is when nobody uses any, in bytes.
    pub room: u64,
}

/// How long a waiting caller pauses when what was given back was not enough. Any number of callers may wait, so none may spin.
const WAITING_PAUSE: Duration = Duration::from_millis(20);

/// The budget. Clones share it.
#[derive(Clone, Debug)]
pub struct Memory(Arc<Budget>);

#[derive(Debug)]
struct Budget {
    room: u64,
    free: Arc<Semaphore>,
    /// Told when something is given back, or less is resident.
    given_back: Notify,
    resident: Resident,
}

/// What the process has of the machine's memory.
#[derive(Debug)]
struct Resident {
    /// As much as may be, in bytes.
    most: u64,
    /// What was measured last, in bytes.
    measured: AtomicU64,
}

/// How often resident memory is measured: so often that little can be added in between.
const MEASURE_EVERY: Duration = Duration::from_millis(20);

impl Memory {
    /// Least that is kept for what takes nothing from the budget.
    const MIN_BASE_BYTES: u64 = 64 << 20;

    /// A budget of `max_bytes`, a third of which is kept for what is too small or too scattered to be counted.
    #[must_use]
    pub fn new(max_bytes: u64) -> Self {
        let base = (max_bytes / 3).max(Self::MIN_BASE_BYTES);
        // What has begun may go on to use what is left beyond this.
        let most = max_bytes - max_bytes / 8;
        Self::with(max_bytes.saturating_sub(base), most)
    }

    /// A budget that has all of `n_bytes` for whoever asks.
    #[must_use]
    pub fn with_room(n_bytes: u64) -> Self {
        Self::with(n_bytes, u64::MAX)
    }

    fn with(n_bytes: u64, most_resident: u64) -> Self {
        let n_units = (n_bytes / UNIT_BYTES).min(u64::from(u32::MAX));
        let n_permits = usize::try_from(n_units).unwrap_or(usize::MAX).min(Semaphore::MAX_PERMITS);
        let resident = Resident { most: most_resident, measured: AtomicU64::new(0) };
        let free = Arc::new(Semaphore::new(n_permits));
        Self(Arc::new(Budget { room: n_bytes, free, given_back: Notify::new(), resident }))
    }

    /// Measures what is resident, again and again. Where that cannot be found out, the budget is what is counted.
    pub async fn watch(self) {
        let mut ticks = tokio::time::interval(MEASURE_EVERY);
        ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        // It is kept open: to find it takes most of the time of reading it.
        let Ok(statm) = File::open(STATM) else { return };
        while let Some(n_bytes) = resident_bytes(&statm) {
            self.note_resident(n_bytes);
            ticks.tick().await;
        }
        self.note_resident(0);
    }

    /// Notes that the process has so much of the machine's memory now.
    fn note_resident(&self, n_bytes: u64) {
        if n_bytes < self.0.resident.measured.swap(n_bytes, Ordering::Relaxed) {
            self.0.given_back.notify_waiters();
        }
    }

    /// How much there is when nobody uses any, in bytes.
    #[must_use]
    pub fn room(&self) -> u64 {
        self.0.room
    }

    /// How much nobody uses now, in bytes.
    #[must_use]
    pub fn free(&self) -> u64 {
        self.0.free.available_permits() as u64 * UNIT_BYTES
    }

    /// How much of that something large may take now, in bytes.
    #[must_use]
    pub fn free_for_large(&self) -> u64 {
        let not_resident = self.0.resident.most.saturating_sub(self.0.resident.measured.load(Ordering::Relaxed));
        self.free().saturating_sub(self.0.room / 8).min(not_resident)
    }

    /// Takes `n_bytes` if they are free.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if they are not.
    pub fn try_take(&self, n_bytes: u64) -> Result<Held, NoRoom> {
        self.try_take_for(n_bytes, n_bytes)
    }

    /// Takes `n_bytes` if they are free, however few, and something is left then for what is small.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if not.
    pub fn try_take_as_large(&self, n_bytes: u64) -> Result<Held, NoRoom> {
        self.try_take_for(u64::MAX, n_bytes)
    }

    /// Makes `held` at least `n_bytes`; fewer than are worth counting take nothing.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if it is not free; then this holds what it did before.
    pub fn reserve(&self, held: &mut Option<Held>, n_bytes: usize) -> Result<(), NoRoom> {
        let n_bytes = n_bytes as u64;
        match held {
            _ if n_bytes <= UNCOUNTED_BYTES => {}
            Some(held) => held.grow_to(n_bytes)?,
            None => *held = Some(self.try_take(n_bytes)?),
        }
        Ok(())
    }

    /// Takes `n_bytes` more for what will then have `n_in_all`.
    fn try_take_for(&self, n_in_all: u64, n_bytes: u64) -> Result<Held, NoRoom> {
        if n_in_all > SMALL_BYTES && n_bytes > self.free_for_large() {
            return Err(self.no_room(n_bytes));
        }
        let permit = Arc::clone(&self.0.free).try_acquire_many_owned(self.units(n_bytes)?);
        let permit = permit.map_err(|_| self.no_room(n_bytes))?;
        Ok(Held { memory: self.clone(), permit })
    }

    /// Takes `n_bytes` as large once they are free. A waiting caller reserves nothing: others may take meanwhile what is free, so that
    /// waiting for long keeps nobody from anything.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if there is never so much.
    pub async fn take(&self, n_bytes: u64) -> Result<Held, NoRoom> {
        if n_bytes > self.0.room - self.0.room / 8 {
            return Err(self.no_room(n_bytes));
        }
        loop {
            let mut given_back = pin!(self.0.given_back.notified());
            given_back.as_mut().enable();
            if let Ok(held) = self.try_take_as_large(n_bytes) {
                return Ok(held);
            }
            given_back.await;
            if let Ok(held) = self.try_take_as_large(n_bytes) {
                return Ok(held);
            }
            tokio::time::sleep(WAITING_PAUSE).await;
        }
    }

    /// What `n_bytes` are in units, if there is so much at all.
    fn units(&self, n_bytes: u64) -> Result<u32, NoRoom> {
        let n_units = if n_bytes <= self.0.room { u32::try_from(n_bytes.div_ceil(UNIT_BYTES)).ok() } else { None };
        n_units.ok_or_else(|| self.no_room(n_bytes))
    }

    fn no_room(&self, wanted: u64) -> NoRoom {
        NoRoom { wanted, room: self.0.room }
    }
}

/// Memory that was taken, until this is dropped.
#[derive(Debug)]
pub struct Held {
    memory: Memory,
    permit: OwnedSemaphorePermit,
}

impl Held {
    /// How much it is, in bytes.
    #[must_use]
    pub fn n_bytes(&self) -> u64 {
        self.permit.num_permits() as u64 * UNIT_BYTES
    }

    /// Takes more, if it is free, until this holds at least `n_bytes`.
    ///
    /// # Errors
    ///
    /// [`NoRoom`] if it is not free; then this holds what it did before.
    pub fn grow_to(&mut self, n_bytes: u64) -> Result<(), NoRoom> {
        if n_bytes > self.n_bytes() {
            let more = self.memory.try_take_for(n_bytes, n_bytes - self.n_bytes());
            self.merge(more.map_err(|_| self.memory.no_room(n_bytes))?);
        }
        Ok(())
    }

    /// Holds what `more` holds too.
    pub fn merge(&mut self, mut more: Self) {
        if let Some(all) = more.permit.split(more.permit.num_permits()) {
            self.permit.merge(all);
        }
    }

    /// Gives back what is not needed to hold `n_bytes`.
    pub fn shrink_to(&mut self, n_bytes: u64) {
        let kept = usize::try_from(n_bytes.div_ceil(UNIT_BYTES)).unwrap_or(usize::MAX);
        drop(self.permit.split(self.permit.num_permits().saturating_sub(kept)));
        self.memory.0.given_back.notify_waiters();
    }
}

impl Drop for Held {
    fn drop(&mut self) {
        self.shrink_to(0);
    }
}

/// What a process may use by default: three quarters of what its machine or its cgroup has, half of its address space.
#[must_use]
pub fn default_max_bytes() -> u64 {
    /// Where nothing can be read of the machine.
    const UNKNOWN: u64 = 4 << 30;
    let resident = [machine_bytes(), cgroup_bytes()].into_iter().flatten().min();
    let by_resident = resident.map(|n_bytes| n_bytes / 4 * 3);
    let by_addresses = address_space_bytes().map(|n_bytes| n_bytes / 2);
    [by_resident, by_addresses].into_iter().flatten().min().unwrap_or(UNKNOWN)
}

/// Where a process finds how much memory it has.
const STATM: &str = "/proc/self/statm";

/// What this process has of the machine's memory.
fn resident_bytes(statm: &File) -> Option<u64> {
    let mut text = [0; 256];
    let n_read = statm.read_at(&mut text, 0).ok()?;
    let text = std::str::from_utf8(&text[..n_read]).ok()?;
    let n_pages: u64 = text.split_whitespace().nth(1)?.parse().ok()?;
    Some(n_pages * rustix::param::page_size() as u64)
}

/// The memory of the machine.
fn machine_bytes() -> Option<u64> {
    let text = fs::read_to_string("/proc/meminfo").ok()?;
    let total = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    Some(total.trim().strip_suffix("kB")?.trim().parse::<u64>().ok()? * 1024)
}

/// The least limit of the cgroups that this process is in, of either version.
fn cgroup_bytes() -> Option<u64> {
    let groups = fs::read_to_string("/proc/self/cgroup").ok()?;
    let files = groups.lines().filter_map(|line| {
        let (_, rest) = line.split_once(':')?;
        let (controllers, path) = rest.split_once(':')?;
        match controllers {
            "" => Some(("/sys/fs/cgroup", path, "memory.max")),
            _ if controllers.split(',').any(|name| name == "memory") => {
                Some(("/sys/fs/cgroup/memory", path, "memory.limit_in_bytes"))
            }
            _ => None,
        }
    });
    // A group has no more than the groups around it. In a container the path may be that of the host, and only the root is there.
    let limits = files.flat_map(|(root, path, file)| {
        let ancestors = std::path::Path::new(path.trim_start_matches('/')).ancestors().map(std::path::Path::to_owned);
        ancestors.filter_map(move |group| {
            let text = fs::read_to_string(std::path::Path::new(root).join(group).join(file)).ok()?;
            text.trim().parse::<u64>().ok()
        })
    });
    limits.min()
}

/// The limit of the process's address space, if it has one.
fn address_space_bytes() -> Option<u64> {
    let limits = fs::read_to_string("/proc/self/limits").ok()?;
    let line = limits.lines().find_map(|line| line.strip_prefix("Max address space"))?;
    line.split_whitespace().next()?.parse().ok()
}

#[cfg(test)]
mod tests;
