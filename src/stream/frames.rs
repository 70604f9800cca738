//! The frames of the protocol.

use serde::Serialize;
use serde_json::Value;

use crate::attribute::{ByAttribute, Scalar};
use crate::document::{Fault, Faults, Place};
use crate::mapping::{CommittedStep, Cost, MoveKind, Policy, Status, Step};

/// What a client sends.
#[derive(Clone, Debug, PartialEq)]
pub enum ClientFrame {
    /// Open a session: the whole frame, read against its model by the session.
    Open(Value),
    /// Observed states.
    Observe {
        /// Index of the first of them.
        seq: u32,
        /// The whole frame, with `states`.
        frame: Value,
    },
    /// The demonstration has ended.
    End {
        /// How many observations it has.
        seq: u32,
    },
    /// Take up a session again.
    Resume {
        /// Its id.
        session: String,
        /// The first step to be sent again.
        step: u32,
    },
    /// What the execution of an exploring session's policy earned.
    Reward {
        /// The reward.
        reward: f64,
    },
}

impl ClientFrame {
    /// Reads a frame.
    ///
    /// # Errors
    ///
    /// Whatever is wrong with it, but for what needs the model to be seen.
    pub fn read(frame: Value) -> Result<Self, Faults> {
        let mut faults = Faults::default();
        let read = Self::read_fields(&frame, &mut faults);
        Ok(match faults.check(read)? {
            Self::Open(_) => Self::Open(frame),
            Self::Observe { seq, .. } => Self::Observe { seq, frame },
            other => other,
        })
    }

    /// Reads the fields; the frames that are kept whole are given without themselves.
    fn read_fields(frame: &Value, faults: &mut Faults) -> Option<Self> {
        let root = Place::root(frame);
        let object = root.open_object(faults)?;
        let kind = object.required("type", faults)?;
        let count = |name: &str, faults: &mut Faults| {
            let count = object.required(name, faults)?.integer(0, u32::MAX.into(), faults)?;
            u32::try_from(count).ok()
        };
        match kind.string(faults)? {
            "open" => Some(Self::Open(Value::Null)),
            "observe" => {
                root.object(&["type", "seq", "states"], faults)?;
                let states = object.required("states", faults).and_then(|place| place.array(faults).map(drop));
                let seq = count("seq", faults);
                states?;
                Some(Self::Observe { seq: seq?, frame: Value::Null })
            }
            "end" => {
                root.object(&["type", "seq"], faults)?;
                Some(Self::End { seq: count("seq", faults)? })
            }
            "resume" => {
                root.object(&["type", "session", "step"], faults)?;
                let session = object.required("session", faults).and_then(|place| place.string(faults));
                let step = match object.optional("step") {
                    Some(_) => count("step", faults),
                    None => Some(0),
                };
                Some(Self::Resume { session: session?.to_owned(), step: step? })
            }
            "reward" => {
                root.object(&["type", "reward"], faults)?;
                let reward = object.required("reward", faults)?;
                Some(Self::Reward { reward: reward.number(crate::document::Range::Finite, faults)? })
            }
            _ => kind.mismatch("one of \"open\", \"observe\", \"end\", \"resume\", \"reward\"", faults),
        }
    }
}

/// What the server sends.
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum ServerFrame<'f> {
    /// The first frame.
    Hello {
        /// The protocol's name.
        protocol: &'static str,
        /// The server's version.
        server: &'static str,
        /// What it takes.
        limits: HelloLimits,
    },
    /// A session is open, or resumed.
    Opened {
        /// Its id, to resume it by.
        session: &'f str,
        /// The trial that it explores, if any.
        trial: Option<&'f str>,
        /// The weights of the distance.
        weights: ByAttribute<f64>,
        /// How many observations are durable.
        received: u32,
        /// How many steps were committed.
        steps: usize,
    },
    /// That many observations are durable.
    Received {
        /// How many.
        seq: u32,
    },
    /// A step that will not be revised.
    Step(StepFrame<'f>),
    /// The policy of the whole demonstration is stored.
    Done {
        /// Its id.
        policy_id: Option<&'f str>,
        /// What was proven of it.
        status: Status,
        /// What it costs.
        cost: Cost,
        /// Its actions, in order.
        actions: &'f [std::sync::Arc<str>],
    },
    /// The reward of the explored trial is durable.
    Rewarded {
        /// The trial.
        trial: &'f str,
        /// Its reward.
        reward: f64,
        /// The order in which its learner accepted it.
        reward_order: Option<u64>,
    },
    /// Something is wrong.
    Error {
        /// What.
        problem: StreamProblem,
    },
}

/// What a server takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct HelloLimits {
    /// Largest frame, in bytes.
    pub frame_bytes: usize,
    /// Largest message of a websocket, in bytes: each is one frame of the protocol, however it is fragmented.
    pub message_bytes: usize,
    /// Most observations of a session.
    pub observations: usize,
    /// How many streams may run at the same time.
    pub streams: usize,
    /// How long nothing may happen in a session before it expires, in milliseconds.
    pub idle_timeout_ms: u64,
    /// How long a client may leave unread what waits for it, in milliseconds.
    pub slow_reader_timeout_ms: u64,
}

/// A committed step.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StepFrame<'f> {
    step: u32,
    observation: u32,
    #[serde(rename = "move")]
    kind: MoveKind,
    action: Option<&'f str>,
    state: &'f ByAttribute<Scalar>,
    action_cost: f64,
    distance: f64,
    cost: f64,
    proven: bool,
    after: u32,
}

impl<'f> From<&'f CommittedStep> for StepFrame<'f> {
    fn from(committed: &'f CommittedStep) -> Self {
        let Step { step, observation, kind, action, state, action_cost, distance, cost, .. } = &committed.step;
        Self {
            step: *step,
            observation: *observation,
            kind: *kind,
            action: action.as_deref(),
            state,
            action_cost: *action_cost,
            distance: *distance,
            cost: *cost,
            proven: committed.is_proven,
            after: committed.after,
        }
    }
}

impl<'f> From<&'f Policy> for ServerFrame<'f> {
    fn from(policy: &'f Policy) -> Self {
        Self::Done {
            policy_id: policy.id.as_deref(),
            status: policy.status,
            cost: policy.cost,
            actions: &policy.actions,
        }
    }
}

/// What is wrong, as in HTTP but for what only HTTP has.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct StreamProblem {
    /// `/problems/` and what kind of problem it is.
    #[serde(rename = "type")]
    pub kind: String,
    /// What happened.
    pub detail: String,
    /// Every fault of the frame, with its place.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub errors: Vec<Fault>,
}

impl StreamProblem {
    /// A problem of the kind `slug`.
    #[must_use]
    pub fn new(slug: &str, detail: impl Into<String>) -> Self {
        Self { kind: format!("/problems/{slug}"), detail: detail.into(), errors: Vec::new() }
    }

    /// A problem of the kind `slug` that consists of faults.
    #[must_use]
    pub fn of(slug: &str, faults: &Faults) -> Self {
        let detail = match faults.listed() {
            [fault] => fault.detail.clone(),
            _ => format!("{} faults", faults.count()),
        };
        Self { errors: faults.listed().to_vec(), ..Self::new(slug, detail) }
    }
}
