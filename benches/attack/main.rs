//! Honest clients before, while and after the service is attacked in every way that was found, at the same time.
//!
//! The service is the program itself, in a process of its own that has [`MEMORY_BYTES`], of which it is told to use [`BUDGET`].
//! Honest clients ask at a fixed rate, whatever is answered; what they wait is counted from when they meant to ask. Attackers share
//! one thread of low priority, and the machine, with them. An argument that is a number says for how many seconds the attack goes on, 300
//! if there is none; others are the attacks that there are to be, by their names, all if there are none.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

mod outside;
#[path = "../worlds/mod.rs"]
mod worlds;

use std::net::Ipv4Addr;
use std::process::{ExitCode, ExitStatus};
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use futures_util::future::join_all;
use outside::{Attack, Attacker, Failure, Group, Honest, Kind, Service, Size};
use tokio::task::JoinSet;
use tokio::time::{Instant, sleep, sleep_until, timeout};
use tokio_util::sync::CancellationToken;

/// What the service's cgroup has; or its address space, beyond what it takes when it starts.
const MEMORY_BYTES: u64 = 1 << 30;

/// What the service is told to use: three quarters of it.
const BUDGET: (&str, u64) = ("768M", 768 << 20);

/// How long honest clients are alone, before and after, or as long as the attack goes on if that is shorter.
const ALONE: Duration = Duration::from_secs(30);

/// Between honest requests.
const INTERVAL: Duration = Duration::from_millis(10);

/// What they ask for, in turn.
const MIX: [Kind; 20] = {
    use Kind::{Cave, GetModel, List, Policy, PutModel, Ready, Stream, Trial};
    [
        Policy, Stream, GetModel, Cave, Policy, Trial, Ready, List, Policy, GetModel, Policy, Stream, PutModel, Cave,
        Policy, Trial, Ready, List, Policy, GetModel,
    ]
};

/// Slices of a phase whose 99th percentiles show how it spreads.
const N_SLICES: usize = 10;

/// Between two rounds of an attack.
const BREATH: Duration = Duration::from_millis(100);

/// How long what an attack needs may take to be registered.
const PREPARATION: Duration = Duration::from_mins(3);

const SIZE: Size = Size {
    n_states: 100_000,
    n_cold: 1_000_000,
    n_observations: 20_000,
    n_bytes: 100 << 20,
    hold: Duration::from_secs(20),
};

fn main() -> Result<ExitCode, Failure> {
    let seconds = std::env::args().skip(1).find_map(|argument| argument.parse().ok()).unwrap_or(300);
    let flags = ["--max-memory", BUDGET.0];
    let group = Group::new(MEMORY_BYTES);
    let first = match &group {
        Ok(group) => {
            println!("in a cgroup of {} MiB, --max-memory {}", MEMORY_BYTES >> 20, BUDGET.0);
            group.enter()
        }
        Err(error) => {
            let idle = Service::start(&flags, ":")?.memory("VmSize").ok_or("no /proc")?;
            println!(
                "no cgroup ({error}): in {} + {} MiB of addresses, --max-memory {}",
                idle >> 20,
                MEMORY_BYTES >> 20,
                BUDGET.0
            );
            format!("ulimit -v {}", (idle + MEMORY_BYTES) / 1024)
        }
    };
    let service = Service::start(&flags, &first)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let named: Vec<String> = std::env::args().skip(1).collect();
    let of_name = |attack: &Attack| named.contains(&format!("{attack:?}"));
    let mut attacks: Vec<Attack> = Attack::ALL.iter().copied().filter(of_name).collect();
    if attacks.is_empty() {
        attacks = Attack::ALL.to_vec();
    }
    runtime.block_on(run(Arc::new(service), &attacks, Duration::from_secs(seconds)))
}

async fn run(service: Arc<Service>, attacks: &[Attack], length: Duration) -> Result<ExitCode, Failure> {
    let cave = worlds::cave(20, 3, 50, 1);
    let honest = Arc::new(Honest::prepare(service.address, Ipv4Addr::LOCALHOST, &cave).await?);
    let mut attackers = Vec::new();
    for attack in attacks.iter().copied() {
        // One that has nothing to attack is left out, and told.
        match timeout(PREPARATION, Attacker::prepare(attack, service.address, SIZE))
            .await
            .map_err(Failure::from)
            .flatten()
        {
            Ok(attacker) => attackers.push(attacker),
            Err(error) => println!("{attack:?} could not be prepared: {error}"),
        }
    }
    println!("prepared; resident {}", resident(&service));

    let alone = ALONE.min(length);
    let before = Phase::watch(&service, &honest, alone).await;
    before.print("before");
    let over = CancellationToken::new();
    let attacking = std::thread::spawn({
        let over = over.clone();
        move || {
            // They stand for other machines, whose processors are not this one's to share.
            let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
            attack(attackers, &over)
        }
    });
    let under = Phase::watch(&service, &honest, length).await;
    over.cancel();
    let attackers = attacking.join().map_err(|_| "the attackers panicked")??;
    under.print("under attack");
    let after = Phase::watch(&service, &honest, alone).await;
    after.print("after");

    println!("\nwhat honest clients were told to come again for");
    for ((kind, why), n) in honest.told().iter() {
        println!("  {:<8} {n:>5}  {why}", format!("{kind:?}"));
    }
    println!("\nattacks: connections by how they ended");
    for attacker in attackers {
        let outcomes = attacker.outcomes().into_iter().map(|(outcome, n)| format!("{outcome} {n}"));
        println!("  {:<16} {}", format!("{:?}", attacker.attack), outcomes.collect::<Vec<_>>().join(", "));
    }
    let alone = Phase { samples: [before.samples.clone(), after.samples.clone()].concat(), ..Phase::default() };
    println!(
        "\n99th percentiles under attack, as multiples of those without (slices of the phase: median [least .. most])"
    );
    println!("  all      {}", compare(&under, &alone, None));
    for kind in Kind::ALL.into_iter().filter(|kind| MIX.contains(kind)) {
        println!("  {:<8} {}", format!("{kind:?}"), compare(&under, &alone, Some(kind)));
    }
    println!("resident {}, of a budget of {} MiB", resident(&service), BUDGET.1 >> 20);
    let n_unanswered: usize = [&before, &under, &after].map(Phase::n_unanswered).iter().sum();
    if let Some(end) = service.end() {
        println!("the service ended: {end}");
    }
    println!("{n_unanswered} honest requests were never answered");
    Ok(if service.end().is_none() && n_unanswered == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// All attacks at once, each again and again, until it is `over`. Gives the attackers back.
fn attack(attackers: Vec<Attacker>, over: &CancellationToken) -> Result<Vec<Attacker>, std::io::Error> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let attacking = attackers.iter().map(async |attacker| -> () {
        loop {
            attacker.attack().await;
            sleep(BREATH).await;
        }
    });
    runtime.block_on(over.run_until_cancelled(join_all(attacking)));
    Ok(attackers)
}

/// An honest request.
#[derive(Clone)]
struct Sample {
    kind: Kind,
    /// When it was meant to be sent, since the phase began.
    at: Duration,
    /// From then until it was answered well.
    waited: Duration,
    /// How often it was told to come again, or why it was never answered.
    asked: Result<u32, String>,
}

/// A time in which honest clients ask.
#[derive(Default)]
struct Phase {
    length: Duration,
    samples: Vec<Sample>,
    n_broken: u64,
    /// Resident memory of the service, in bytes, each tenth of a second.
    resident: Vec<u64>,
    /// How the service ended, and when.
    end: Option<(Duration, ExitStatus)>,
}

impl Phase {
    /// Has honest clients ask for so long, and waits for the last answer.
    async fn watch(service: &Arc<Service>, honest: &Arc<Honest>, length: Duration) -> Self {
        let broken_before = honest.n_broken.load(Ordering::Relaxed);
        let sampled = Arc::new(Mutex::new(Vec::new()));
        let sampler = {
            let (service, sampled) = (Arc::clone(service), Arc::clone(&sampled));
            // Not among the clients, who may be busy.
            std::thread::spawn(move || {
                while Arc::strong_count(&sampled) > 1 {
                    sampled.lock().unwrap_or_else(PoisonError::into_inner).extend(service.memory("VmRSS"));
                    std::thread::sleep(Duration::from_millis(100));
                }
            })
        };
        let started = Instant::now();
        let (mut asking, mut samples, mut end) = (JoinSet::new(), Vec::new(), None);
        for (n, kind) in (0_u32..).zip(MIX.into_iter().cycle()) {
            let at = n * INTERVAL;
            if at >= length || end.is_some() {
                break;
            }
            sleep_until(started + at).await;
            let honest = Arc::clone(honest);
            asking.spawn(async move {
                let asked = honest.ask(kind, n as usize).await;
                Sample { kind, at, waited: started.elapsed().saturating_sub(at), asked }
            });
            end = service.end().map(|end| (started.elapsed(), end));
        }
        if end.is_some() {
            asking.abort_all();
        }
        while let Some(sample) = asking.join_next().await {
            samples.extend(sample.ok());
        }
        end = end.or_else(|| Some((started.elapsed(), service.end()?)));
        let resident = std::mem::take(&mut *sampled.lock().unwrap_or_else(PoisonError::into_inner));
        drop(sampled);
        drop(sampler.join());
        let n_broken = honest.n_broken.load(Ordering::Relaxed) - broken_before;
        Self { length, samples, n_broken, resident, end }
    }

    fn n_unanswered(&self) -> usize {
        self.samples.iter().filter(|sample| sample.asked.is_err()).count()
    }

    /// What answers took, sorted, in milliseconds: all, or those of a kind; of the whole, or of a slice.
    fn waited(&self, kind: Option<Kind>, slice: Option<usize>) -> Vec<f64> {
        let is_in = |sample: &&Sample| {
            let in_slice = slice.is_none_or(|slice| {
                let length = self.length / u32::try_from(N_SLICES).unwrap_or(1);
                (slice as u128 * length.as_nanos()..(slice as u128 + 1) * length.as_nanos())
                    .contains(&sample.at.as_nanos())
            });
            in_slice && sample.asked.is_ok() && kind.is_none_or(|kind| kind == sample.kind)
        };
        let mut waited: Vec<f64> =
            self.samples.iter().filter(is_in).map(|sample| sample.waited.as_secs_f64() * 1e3).collect();
        waited.sort_unstable_by(f64::total_cmp);
        waited
    }

    fn print(&self, name: &str) {
        println!(
            "\n{name}, {} s\n           count  unanswered  retried    median        99 %         max  (ms)",
            self.length.as_secs()
        );
        for kind in std::iter::once(None).chain(Kind::ALL.into_iter().filter(|kind| MIX.contains(kind)).map(Some)) {
            let of_kind = self.samples.iter().filter(|sample| kind.is_none_or(|kind| kind == sample.kind));
            let (mut n, mut n_unanswered, mut n_retried) = (0, 0, 0);
            for sample in of_kind {
                n += 1;
                n_unanswered += usize::from(sample.asked.is_err());
                n_retried += usize::from(sample.asked.as_ref().is_ok_and(|n_retries| *n_retries > 0));
            }
            let waited = self.waited(kind, None);
            let name = kind.map_or("all".to_owned(), |kind| format!("{kind:?}"));
            let [median, high, most] = [0.5, 0.99, 1.0].map(|part| percentile(&waited, part));
            println!("  {name:<8} {n:>6} {n_unanswered:>11} {n_retried:>8} {median:>9.1} {high:>11.1} {most:>11.1}");
        }
        let mib = |n_bytes: Option<&u64>| n_bytes.map_or("?".to_owned(), |n_bytes| (n_bytes >> 20).to_string());
        let mut resident = self.resident.clone();
        resident.sort_unstable();
        let (median, most) = (mib(resident.get(resident.len() / 2)), mib(resident.last()));
        println!("  resident: median {median} MiB, most {most} MiB; {} connections refused or broken", self.n_broken);
        let mut whys: Vec<&String> = self.samples.iter().filter_map(|sample| sample.asked.as_ref().err()).collect();
        whys.dedup();
        whys.iter().take(3).for_each(|why| println!("  unanswered, such as: {why}"));
        if let Some((when, end)) = &self.end {
            println!("  the service ended after {:.1} s: {end}", when.as_secs_f64());
        }
    }
}

/// The least of `sorted` that such a part is not above.
#[expect(
    clippy::cast_precision_loss,
    clippy::cast_possible_truncation,
    clippy::cast_sign_loss,
    reason = "counts are small"
)]
fn percentile(sorted: &[f64], part: f64) -> f64 {
    let rank = (sorted.len() as f64 * part).ceil() as usize;
    sorted.get(rank.saturating_sub(1)).copied().unwrap_or(f64::NAN)
}

fn compare(under: &Phase, alone: &Phase, kind: Option<Kind>) -> String {
    let base = percentile(&alone.waited(kind, None), 0.99);
    let whole = percentile(&under.waited(kind, None), 0.99) / base;
    let slices = (0..N_SLICES).map(|slice| under.waited(kind, Some(slice))).filter(|waited| !waited.is_empty());
    let mut ratios: Vec<f64> = slices.map(|waited| percentile(&waited, 0.99) / base).collect();
    ratios.sort_unstable_by(f64::total_cmp);
    let [least, median, most] = [0.0, 0.5, 1.0].map(|part| percentile(&ratios, part));
    format!("{whole:>8.1}   ({median:.1} [{least:.1} .. {most:.1}])")
}

fn resident(service: &Service) -> String {
    let mib = |figure| service.memory(figure).map_or("?".to_owned(), |n_bytes| (n_bytes >> 20).to_string());
    format!("{} MiB, at most {} MiB so far", mib("VmRSS"), mib("VmHWM"))
}
