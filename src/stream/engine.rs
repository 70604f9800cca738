//! The protocol, one connection at a time.

use std::pin::pin;
use std::time::Duration;

use tokio::sync::SetOnce;
use tokio_util::sync::CancellationToken;

use super::closing::{Closed, Over, ends, not_allowed};
use super::frames::{ClientFrame, HelloLimits, ServerFrame};
use super::limits::Limits;
use super::messages::{Incoming, Outgoing, read_frame, text_of};
use super::outlet::Outlet;
use super::problem::StreamProblem;
use super::queue::{Queued, Receiver, Sender, Weighed};
use super::room::{SMALL_FRAME_BYTES, Taken};
use crate::client::Client;
use crate::clock::timer_now;
use crate::service::{AcceptedReward, Caller, Ended, Etude, Resumed, RewardState, ServiceError, Session, SessionError};
use etude_core::mapping::PassedStates;

/// The protocol's name; also the websocket subprotocol.
pub const PROTOCOL: &str = "etude.v1+json";

/// After so many bytes of frames, which take about half a millisecond to be answered where nothing is to be searched or stored, others have
/// their turn.
const BYTES_IN_A_ROW: usize = 16 << 10;

/// What a frame counts for at least, however short it is.
const MIN_FRAME_BYTES: usize = 512;

/// How long the last words may wait for a client that does not read.
const GOODBYE_TIMEOUT: Duration = Duration::from_secs(2);

/// Speaks the protocol until the connection is over, and says why it is: at once if the session is taken over, the server
/// shuts down, or the transport has `lost` the client, whatever is under way. Dropping the future at any time leaves a session that can be
/// resumed.
pub async fn run(
    etude: &Etude,
    client: Client,
    limits: Limits,
    incoming: &mut Receiver<Incoming>,
    outgoing: &Sender<Outgoing>,
    stopping: &CancellationToken,
    lost: impl Future<Output = Closed>,
) -> Closed {
    let taken_over = SetOnce::new();
    let outlet = Outlet { outgoing, limits };
    let mut connection = Connection {
        etude,
        client,
        limits,
        outlet,
        session: None,
        next: None,
        taken_over: &taken_over,
        is_reward_told: false,
    };
    let (ended, is_lost) = tokio::select! {
        biased;
        () = stopping.cancelled() => {
            let problem = StreamProblem::new("stopping", "the server shuts down; resume the session later");
            (Err(Over::because(Closed::GoingAway, problem)), false)
        }
        () = async { taken_over.wait().await.cancelled().await } => (Err(ends(&SessionError::TakenOver)), false),
        closed = lost => (Ok(closed), true),
        ended = connection.speak(incoming) => (ended, false),
    };
    // Given back now: whoever takes it over does not wait for the goodbye.
    let session = connection.session.take().map(|session| session.id().to_owned());
    let (closed, problem) = match ended {
        Ok(closed) => (closed, None),
        Err(Over { closed, problem }) => (closed, problem),
    };
    let (code, _) = closed.code();
    tracing::info!(code, session, is_lost, "stream closed");
    let goodbye = async {
        if let Some(problem) = problem {
            // Where this does not get through, the close code says it too.
            let _ = outlet.send(&ServerFrame::Error { problem }).await;
        }
        // A client that is stuck does not hear this.
        let _ = outgoing.send(Outgoing::Close(closed)).await;
    };
    if !is_lost {
        let _ = tokio::time::timeout(limits.slow_after.min(GOODBYE_TIMEOUT), goodbye).await;
    }
    closed
}

pub(super) struct Connection<'c> {
    pub(super) etude: &'c Etude,
    client: Client,
    pub(super) limits: Limits,
    pub(super) outlet: Outlet<'c>,
    pub(super) session: Option<Session>,
    /// What was taken out of the queue, and is answered next.
    pub(super) next: Option<Queued<Incoming>>,
    /// Tells when another connection takes the session over, once there is one.
    taken_over: &'c SetOnce<CancellationToken>,
    /// Whether the client was told here that its reward is accepted.
    is_reward_told: bool,
}

impl Connection<'_> {
    async fn speak(&mut self, incoming: &mut Receiver<Incoming>) -> Result<Closed, Over> {
        self.outlet
            .send(&ServerFrame::Hello {
                protocol: PROTOCOL,
                server: env!("CARGO_PKG_VERSION"),
                limits: HelloLimits::from(self.limits),
            })
            .await?;
        let mut n_bytes_in_a_row = 0;
        // Set anew when it goes off, not with each frame.
        let mut alarm = pin!(tokio::time::sleep(self.limits.idle_after));
        loop {
            if n_bytes_in_a_row >= BYTES_IN_A_ROW {
                n_bytes_in_a_row = 0;
                tokio::task::yield_now().await;
            }
            let mut next = self.next.take();
            let idle_at = timer_now() + self.limits.idle_after;
            let came = loop {
                let coming = async {
                    match next.take() {
                        Some(next) => Some(next),
                        None => incoming.recv().await,
                    }
                };
                tokio::select! {
                    // What has come by the time that a step is due decides, not what waits to be received.
                    biased;
                    () = self.is_due() => self.decide().await?,
                    came = coming => break came,
                    () = &mut alarm => {
                        if timer_now() >= idle_at {
                            let problem = StreamProblem::new("idle", "nothing came for too long");
                            return Err(Over::because(Closed::NotAllowed, problem));
                        }
                        alarm.as_mut().reset(idle_at);
                    }
                }
            };
            let Some(came) = came else { return Ok(Closed::ByClient) };
            let n_bytes = came.item.n_bytes();
            n_bytes_in_a_row += n_bytes.max(MIN_FRAME_BYTES);
            // Its room in the queue is given back once it is answered.
            let closed = if let Some(coming) = self.take_in_next(&came.item) {
                self.receive(coming, n_bytes, incoming, self.etude.clock().now()).await?
            } else {
                let (frame, memory) = self.read(came.item).await?;
                self.answer(frame, memory, n_bytes, incoming).await?
            };
            if let Some(closed) = closed {
                return Ok(closed);
            }
        }
    }

    /// Waits until a step of the session is due, if one waits for so long at most.
    async fn is_due(&self) {
        match self.session.as_ref().and_then(Session::due) {
            Some(due) => self.etude.clock().sleep_until(due).await,
            None => std::future::pending().await,
        }
    }

    /// Commits the steps that are due.
    async fn decide(&mut self) -> Result<(), Over> {
        let Some(session) = &mut self.session else { return Ok(()) };
        let steps = session.decide(self.etude).await.map_err(|error| ends(&error))?;
        self.outlet.send_steps(&steps).await
    }

    /// Reads what came: a large frame off the threads that serve others. Gives its memory along.
    async fn read(&self, came: Incoming) -> Result<(ClientFrame, Option<Taken>), Over> {
        let (text, memory) = text_of(came, self.limits)?;
        if text.len() <= SMALL_FRAME_BYTES {
            return Ok((read_frame(&text)?, memory));
        }
        let reading = self.etude.pool().read_in_turn(self.client, text.len(), move || read_frame(&text));
        Ok((reading.await.map_err(|error| ends(&error.into()))??, memory))
    }

    /// Answers a frame of `n_bytes`, whose memory is `memory`. Gives how the connection ends, if it does.
    async fn answer(
        &mut self,
        frame: ClientFrame,
        memory: Option<Taken>,
        n_bytes: usize,
        incoming: &mut Receiver<Incoming>,
    ) -> Result<Option<Closed>, Over> {
        let (clock, client) = (self.etude.clock(), self.client);
        let caller = Caller { client, arrived: clock.instant(), now: clock.now() };
        let now = caller.now;
        match (frame, &mut self.session) {
            (ClientFrame::Open(_) | ClientFrame::Resume { .. }, Some(_)) => {
                Err(not_allowed("a session is open already"))
            }
            (ClientFrame::Open(request), None) => {
                let session = self.etude.open_session(&request, caller).await.map_err(|error| ends(&error))?;
                self.opened(session).await?;
                Ok(None)
            }
            (ClientFrame::Resume { session, step }, None) => {
                let Resumed { session, kept, steps, policy } =
                    self.etude.resume_session(&session, caller).await.map_err(|error| ends(&error))?;
                let mapper = session.mapper();
                self.opened(session).await?;
                let mut passed = PassedStates::new(mapper.model());
                for (number, kept) in (0..).zip(&kept) {
                    kept.pass(&mut passed);
                    if number >= step {
                        self.outlet.send(&ServerFrame::Step((&kept.written(number, &passed)).into())).await?;
                    }
                }
                let n_kept = kept.len();
                self.outlet.send_steps(steps.get((step as usize).saturating_sub(n_kept)..).unwrap_or_default()).await?;
                let Some(policy) = policy else { return Ok(None) };
                self.outlet.send(&ServerFrame::from(&policy)).await?;
                self.done().await
            }
            (ClientFrame::Observe { .. } | ClientFrame::End { .. }, None) => {
                Err(not_allowed("open or resume a session first"))
            }
            (ClientFrame::Reward { reward }, Some(session)) if let Some(trial) = session.trial_id() => {
                let has_ended = session.has_ended();
                match self.etude.accept_reward(trial, reward, now).await {
                    Ok(rewarded) => {
                        let trial = rewarded.trial;
                        let order = trial.reward.as_ref().map(|reward| reward.reward_order);
                        self.outlet
                            .send(&ServerFrame::Rewarded { trial: &trial.id, reward, reward_order: order })
                            .await?;
                        self.is_reward_told = true;
                        Ok(has_ended.then_some(Closed::Done))
                    }
                    Err(error) => self.go_on_or_end(&error.into()).await,
                }
            }
            (ClientFrame::Reward { .. }, _) => Err(not_allowed("only an exploring session takes a reward")),
            (ClientFrame::Observe { seq, frame }, Some(_)) => {
                self.observe(seq, (frame, memory), n_bytes, incoming, now).await
            }
            (ClientFrame::End { seq }, Some(session)) => match session.end(self.etude, seq, now).await {
                Ok(ended) => self.ended(&ended).await,
                Err(error) => self.go_on_or_end(&error).await,
            },
        }
    }

    /// Tells the client how its demonstration has ended.
    pub(super) async fn ended(&mut self, Ended { steps, policy }: &Ended) -> Result<Option<Closed>, Over> {
        self.outlet.send_steps(steps).await?;
        self.outlet.send(&ServerFrame::from(policy)).await?;
        self.done().await
    }

    /// How the connection ends once the policy is done, unless a reward is still to come.
    async fn done(&mut self) -> Result<Option<Closed>, Over> {
        let Some(session) = &self.session else { return Ok(Some(Closed::Done)) };
        match session.reward(self.etude).await.map_err(|error| ends(&error))? {
            RewardState::Awaited => Ok(None),
            RewardState::Never => Ok(Some(Closed::Done)),
            RewardState::Accepted { trial, reward } => {
                // Whoever was cut off may not have heard it.
                if !self.is_reward_told {
                    let AcceptedReward { reward, reward_order } = reward;
                    let frame = ServerFrame::Rewarded { trial: &trial, reward, reward_order: Some(reward_order) };
                    self.outlet.send(&frame).await?;
                }
                Ok(Some(Closed::Done))
            }
        }
    }

    async fn opened(&mut self, session: Session) -> Result<(), Over> {
        tracing::info!(session = session.id(), received = session.n_received(), "stream opened");
        let session = self.session.insert(session);
        // A connection has one session.
        let _ = self.taken_over.set(session.taken_over().clone());
        let frame = ServerFrame::Opened {
            session: session.id(),
            trial: session.trial_id(),
            weights: session.weights(),
            received: session.n_received(),
            steps: session.n_steps(),
        };
        self.outlet.send(&frame).await
    }

    /// Tells the client of an error after which the session goes on, or ends the connection.
    pub(super) async fn go_on_or_end(&self, error: &SessionError) -> Result<Option<Closed>, Over> {
        let problem = match error {
            SessionError::Gap { .. } => StreamProblem::new("gap", error.to_string()),
            SessionError::TooMany => StreamProblem::new("too-many-observations", error.to_string()),
            SessionError::Empty => StreamProblem::new("empty", error.to_string()),
            SessionError::Ended => StreamProblem::new("ended", error.to_string()),
            SessionError::Service(ServiceError::AlreadyRewarded { .. }) => {
                StreamProblem::new("already-rewarded", error.to_string())
            }
            SessionError::Service(ServiceError::TrialFailed { .. }) => {
                StreamProblem::new("trial-failed", error.to_string())
            }
            SessionError::Faults(faults) => {
                let mut problem = StreamProblem::of("invalid", faults);
                // Places are within the frame.
                problem.detail = format!("none of the frame's states was taken: {}", problem.detail);
                problem
            }
            SessionError::NotOpen
            | SessionError::TakenOver
            | SessionError::TooManySteps(_)
            | SessionError::Service(_) => return Err(ends(error)),
        };
        self.outlet.send(&ServerFrame::Error { problem }).await?;
        Ok(None)
    }
}
