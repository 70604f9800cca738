//! What is decided by time, and what a session goes on from.

use std::path::Path;
use std::sync::Arc;

use jiff::Timestamp;
use proptest::prelude::*;
use serde_json::json;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::super::kept::Kept;
use super::super::tests::receive;
use super::super::{Received, Resumed, Session};
use super::*;
use crate::client::Client;
use crate::clock::Clock;
use crate::service::{Caller, Etude, ModelText, Name, Settings};
use etude_core::mapping::{CommittedStep, PassedStates};
use etude_core::model::{Format, Limits};

/// How long steps wait in these sessions.
const LIMIT: Duration = Duration::from_secs(1);

/// A service of figure 4 whose clock is stepped, and what runs in its background.
struct Service {
    etude: Arc<Etude>,
    clock: Clock,
    tasks: TaskTracker,
    stopping: CancellationToken,
}

impl Service {
    async fn start(directory: &Path, clock: &Clock) -> Self {
        Self::start_within(directory, clock, Limits::DEFAULT).await
    }

    /// Where models may not be larger.
    async fn start_within(directory: &Path, clock: &Clock, limits: Limits) -> Self {
        let tasks = TaskTracker::new();
        let settings = Settings { clock: clock.clone(), limits, ..Settings::of_test(directory) };
        let etude = Arc::new(Etude::open(&settings, &tasks, CancellationToken::new()).await.unwrap());
        etude.begin(clock.now()).await.unwrap();
        let stopping = CancellationToken::new();
        let service = Self { etude, clock: clock.clone(), tasks, stopping };
        let model = include_str!("../../../../examples/figure-4/model.json");
        let text = ModelText::Whole(model.as_bytes().to_vec());
        service.etude.put_model(&Name::new("m").unwrap(), text, Format::Json, service.caller()).await.unwrap();
        service
    }

    fn caller(&self) -> Caller {
        Caller { client: Client::LOCAL, arrived: self.clock.instant(), now: self.clock.now() }
    }

    /// Lets it decide in sessions that nobody drives.
    fn attend(&self) {
        self.tasks.spawn(Arc::clone(&self.etude).attend_until(self.stopping.clone()));
    }

    async fn open(&self, mut open: serde_json::Value) -> Session {
        open["type"] = json!("open");
        open["model"] = json!("m");
        self.etude.open_session(&open, self.caller()).await.unwrap()
    }

    async fn observe(&self, session: &mut Session, states: &[serde_json::Value]) -> Vec<CommittedStep> {
        let (seq, states) = (session.n_received(), json!(states));
        let received = receive(&self.etude, session, seq, &states, self.clock.now()).await;
        match received {
            Received::Mapped(steps) => steps.to_vec(),
            Received::Waiting(observations) => session.advance(&self.etude, observations).await.unwrap().to_vec(),
        }
    }

    async fn decide(&self, session: &mut Session) -> Vec<CommittedStep> {
        session.decide(&self.etude).await.unwrap().to_vec()
    }

    async fn resume(&self, id: &str) -> (Session, Vec<CommittedStep>) {
        let Resumed { session, kept, steps, .. } = self.etude.resume_session(id, self.caller()).await.unwrap();
        let model = session.mapper();
        let mut passed = PassedStates::new(model.model());
        let kept = (0..).zip(&kept).map(|(number, kept)| {
            kept.pass(&mut passed);
            kept.written(number, &passed)
        });
        (session, kept.chain(steps.iter().cloned()).collect())
    }

    /// As if it was killed, unless it notes that it ends.
    async fn stop(self) {
        self.stopping.cancel();
        self.etude.close().await;
        drop(self.etude);
        self.tasks.close();
        self.tasks.wait().await;
    }
}

fn demonstration() -> Vec<serde_json::Value> {
    serde_json::from_str(include_str!("../../../../examples/figure-4/demonstration.json")).unwrap()
}

fn clock() -> Clock {
    Clock::stepped(Timestamp::from_second(1_700_000_000).unwrap())
}

/// What is told of steps, to the bit.
fn told(steps: &[CommittedStep]) -> Vec<String> {
    let told = |CommittedStep { step, is_proven, after }: &CommittedStep| {
        let state = serde_json::to_string(&step.state).unwrap();
        let numbers = [step.action_cost, step.distance, step.cost].map(f64::to_bits);
        format!(
            "{} {} {:?} {:?} {state} {numbers:?} {is_proven} {after}",
            step.step, step.observation, step.kind, step.action
        )
    };
    steps.iter().map(told).collect()
}

#[test]
fn a_step_is_due_once_the_observation_that_it_advances_to_has_come_so_long_ago() {
    let ms = Duration::from_millis;
    let now = Clock::system().instant();
    let mut waits = Waits::of(NonZeroU64::new(100)).unwrap();
    assert_eq!(waits.next(0, 0), None);
    waits.came(0, Duration::ZERO, now);
    waits.came(3, Duration::ZERO, now + ms(30));
    waits.came(4, ms(70), now + ms(80));
    assert_eq!(waits.next(0, 5), Some(now + ms(100)));
    assert_eq!(waits.n_due(5, now + ms(99)), 0);
    assert_eq!(waits.n_due(5, now + ms(100)), 3);
    waits.met(2);
    assert_eq!(waits.next(2, 5), Some(now + ms(100)));
    waits.met(3);
    assert_eq!(waits.next(3, 5), Some(now + ms(130)));
    waits.met(4);
    assert_eq!(waits.next(4, 5), Some(now + ms(110)));
    assert_eq!(waits.n_due(5, now + ms(130)), 5);
    waits.met(5);
    assert_eq!(waits.next(5, 5), None, "what it advances to has not come");
    waits.came(5, ms(1000), now);
    waits.met(5);
    assert_eq!(waits.next(5, 6), Some(now));
    assert!(Waits::of(None).is_none());
    let mut waits = Waits::of(NonZeroU64::new(u64::MAX)).unwrap();
    waits.came(0, Duration::ZERO, now);
    assert_eq!(waits.n_due(1, now + ms(1 << 30)), 0);
}

#[tokio::test]
async fn a_step_waits_no_longer_than_it_may_and_what_has_come_by_then_decides() {
    let (directory, clock) = (tempfile::tempdir().unwrap(), clock());
    let service = Service::start(directory.path(), &clock).await;
    // Nothing is seen that tells starts apart.
    let nothing = [json!({}), json!({}), json!({})];
    let mut session = service.open(json!({"lookahead": null, "lookahead_ms": 1000, "start": [0, 5, 9]})).await;
    assert_eq!(session.due(), None);
    assert_eq!(service.observe(&mut session, &nothing[..1]).await, []);
    clock.step(LIMIT / 2);
    assert_eq!(service.observe(&mut session, &nothing[1..]).await, []);
    assert_eq!(
        session.due(),
        Some(clock.instant() + LIMIT / 2),
        "the start is decided like a move to the first observation"
    );
    assert_eq!(service.decide(&mut session).await, [], "it is too early");
    clock.step(LIMIT / 2);
    let first = service.decide(&mut session).await;
    assert_eq!(first.iter().map(|step| (step.step.observation, step.after)).collect::<Vec<_>>(), [(0, 3)]);
    assert_eq!(session.due(), Some(clock.instant() + LIMIT / 2));
    // Both observations came at the same time.
    clock.step(LIMIT / 2);
    let rest = service.decide(&mut session).await;
    assert_eq!(rest.last().map(|step| (step.step.observation, step.after)), Some((2, 3)));
    assert!(
        rest.iter().all(|step| step.step.observation > 0 || step.step.kind == etude_core::mapping::MoveKind::Extra)
    );
    assert_eq!(session.due(), None);

    // What was decided is what is resumed, though nothing else tells of it.
    let (id, all) = (session.id().to_owned(), [first, rest].concat());
    drop(session);
    let (resumed, again) = service.resume(&id).await;
    assert_eq!(told(&again), told(&all));
    assert_eq!((resumed.n_received(), resumed.n_steps(), resumed.due()), (3, all.len(), None));
    drop(resumed);
    service.stop().await;
}

#[tokio::test]
async fn the_earlier_of_both_decides() {
    let (directory, clock, seen) = (tempfile::tempdir().unwrap(), clock(), demonstration());
    let service = Service::start(directory.path(), &clock).await;
    let plain = &mut service.open(json!({"lookahead": 2})).await;
    let timed = &mut service.open(json!({"lookahead": 2, "lookahead_ms": 1000})).await;
    for state in &seen[..8] {
        let steps = service.observe(plain, std::slice::from_ref(state)).await;
        assert_eq!(told(&service.observe(timed, std::slice::from_ref(state)).await), told(&steps));
        clock.step(LIMIT / 10);
        assert_eq!(service.decide(timed).await, [], "the lookahead is earlier");
    }
    let n_steps = timed.n_steps();
    clock.step(LIMIT);
    assert!(!service.decide(timed).await.is_empty());
    assert!(timed.n_steps() > n_steps);
    assert_eq!(plain.due(), None, "nobody waits for it");
    service.stop().await;
}

#[tokio::test]
async fn who_is_away_finds_what_time_has_decided() {
    let (directory, clock, seen) = (tempfile::tempdir().unwrap(), clock(), demonstration());
    let service = Service::start(directory.path(), &clock).await;
    service.attend();
    let mut session = service.open(json!({"lookahead": null, "lookahead_ms": 1000})).await;
    service.observe(&mut session, &seen[..4]).await;
    clock.step(LIMIT / 2);
    service.observe(&mut session, &seen[4..6]).await;
    let id = session.id().to_owned();
    drop(session);
    // Nobody asks for the session while it decides.
    let n_kept = async || {
        let stored = service.etude.store.steps(&id).await.unwrap();
        stored.map_or(0, |stored| Kept::read(&stored, &id).unwrap().n_met())
    };
    for (step, expected) in [(LIMIT / 2, 4), (LIMIT / 2, 6)] {
        clock.step(step);
        let until = tokio::time::timeout(Duration::from_secs(30), async {
            while n_kept().await < expected {
                tokio::task::yield_now().await;
            }
        });
        until.await.unwrap();
        assert_eq!(n_kept().await, expected);
    }
    let (session, steps) = service.resume(&id).await;
    assert_eq!(session.due(), None);
    let by_observation = |n| steps.iter().rfind(|step| step.step.observation == n).unwrap().after;
    assert_eq!(by_observation(5), 6);
    drop(session);
    service.stop().await;
}

#[tokio::test]
async fn time_in_which_the_service_is_down_does_not_count_for_steps() {
    let (directory, clock, seen) = (tempfile::tempdir().unwrap(), clock(), demonstration());
    let service = Service::start(directory.path(), &clock).await;
    let mut session = service.open(json!({"lookahead": null, "lookahead_ms": 1000})).await;
    service.observe(&mut session, &seen[..2]).await;
    clock.step(LIMIT * 3 / 4);
    service.observe(&mut session, &seen[2..3]).await;
    clock.step(LIMIT / 4);
    assert!(!service.decide(&mut session).await.is_empty());
    let id = session.id().to_owned();
    // It ends as services do.
    service.etude.note_alive(clock.now()).await.unwrap();
    drop(session);
    service.stop().await;
    clock.step(Duration::from_hours(10));
    let service = Service::start(directory.path(), &clock).await;
    clock.step(LIMIT / 4);
    let (session, steps) = service.resume(&id).await;
    assert_eq!(steps.last().map(|step| (step.step.observation, step.after)), Some((1, 3)));
    assert_eq!(session.due(), Some(clock.instant() + LIMIT / 2), "a quarter before, and a quarter after");
    drop(session);
    // Killed: the last that is known of it is that it was resumed.
    service.stop().await;
    clock.step(Duration::from_hours(10));
    let service = Service::start(directory.path(), &clock).await;
    service.attend();
    clock.step(LIMIT / 2);
    let until = tokio::time::timeout(Duration::from_secs(30), async {
        loop {
            let stored = service.etude.store.steps(&id).await.unwrap();
            if stored.is_some_and(|stored| Kept::read(&stored, &id).unwrap().n_met() == 3) {
                break;
            }
            tokio::task::yield_now().await;
        }
    });
    until.await.unwrap();
    let (session, steps) = service.resume(&id).await;
    assert_eq!((session.due(), steps.last().unwrap().after), (None, 3));
    drop(session);
    service.stop().await;
}

/// Something that happens to a session.
#[derive(Clone, Copy, Debug)]
enum Event {
    /// So many observations come.
    Observe(usize),
    /// Time passes, in tenths of what a step waits.
    Wait(u32),
    /// The connection is lost, and another one resumes it.
    Resume,
    /// The service ends without a word, and another one is started.
    Restart,
}

fn events() -> impl Strategy<Value = Vec<Event>> {
    let event = prop_oneof![
        6 => (1..5_usize).prop_map(Event::Observe),
        1 => Just(Event::Observe(300)),
        3 => (1..12_u32).prop_map(Event::Wait),
        2 => Just(Event::Resume),
        1 => Just(Event::Restart),
    ];
    proptest::collection::vec(event, 1..16)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// A session that is never left is what others are held against: it decides at the same times.
    #[test]
    fn a_session_that_is_broken_off_again_and_again_gives_what_an_unbroken_one_gives(
        events in events(),
        lookahead in prop_oneof![Just(json!(null)), (1..9_u32).prop_map(|lookahead| json!(lookahead))],
        lookahead_ms in prop_oneof![Just(json!(null)), Just(json!(1000))],
        end_weight in 0..3_u32,
        extra_weight in prop_oneof![Just(1.0), Just(0.0), Just(0.5)],
        is_lazy in any::<bool>(),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let (directories, clock) = ([(); 2].map(|()| tempfile::tempdir().unwrap()), clock());
            let seen = demonstration();
            let seen: Vec<_> = seen.iter().chain(seen.iter().rev()).cycle().take(5000).cloned().collect();
            let limits = if is_lazy { Limits { max_states: 0, ..Limits::DEFAULT } } else { Limits::DEFAULT };
            // Without one, only small models are proven.
            let lookahead = if is_lazy && lookahead.is_null() { json!(5) } else { lookahead };
            let open = json!({
                "lookahead": lookahead, "lookahead_ms": lookahead_ms, "end_weight": end_weight, "extra_weight": extra_weight,
            });
            let unbroken = Service::start_within(directories[0].path(), &clock, limits).await;
            let mut service = Service::start_within(directories[1].path(), &clock, limits).await;
            let mut expected_session = unbroken.open(open.clone()).await;
            let mut session = service.open(open).await;
            let id = session.id().to_owned();
            let (mut expected, mut steps) = (Vec::new(), Vec::new());
            for event in events {
                match event {
                    Event::Observe(n) => {
                        let from = session.n_received() as usize;
                        let states = &seen[from..from + n];
                        expected.extend(unbroken.observe(&mut expected_session, states).await);
                        steps.extend(service.observe(&mut session, states).await);
                    }
                    Event::Wait(tenths) => {
                        clock.step(LIMIT * tenths / 10);
                        expected.extend(unbroken.decide(&mut expected_session).await);
                        steps.extend(service.decide(&mut session).await);
                        // A sign of life, so that nothing but what is down does not count.
                        service.etude.note_alive(clock.now()).await.unwrap();
                    }
                    Event::Resume => {
                        drop(session);
                        (session, steps) = service.resume(&id).await;
                    }
                    Event::Restart => {
                        drop(session);
                        service.stop().await;
                        service = Service::start_within(directories[1].path(), &clock, limits).await;
                        (session, steps) = service.resume(&id).await;
                    }
                }
                prop_assert_eq!(told(&steps), told(&expected));
                prop_assert_eq!(session.due(), expected_session.due());
                prop_assert_eq!(session.n_steps(), expected.len());
            }
            if session.n_received() > 0 {
                let n_received = session.n_received();
                let policy_of = async |service: &Service, mut session: Session| {
                    let ended = session.end(&service.etude, n_received, service.clock.now()).await.unwrap();
                    let policy = service.etude.store.policy(ended.policy.id.as_ref().unwrap()).await.unwrap().unwrap();
                    (told(&ended.steps), policy)
                };
                let (expected, expected_policy) = policy_of(&unbroken, expected_session).await;
                let (rest, policy) = policy_of(&service, session).await;
                prop_assert_eq!(rest, expected);
                let answer = |text: &str| {
                    let mut answer: serde_json::Value = serde_json::from_str(text).unwrap();
                    answer["id"].take();
                    answer["search"]["elapsed_us"].take();
                    answer
                };
                prop_assert_eq!(answer(&policy), answer(&expected_policy));
            }
            unbroken.stop().await;
            service.stop().await;
            Ok(())
        })?;
    }
}
