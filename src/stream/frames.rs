//! The frames of the protocol.

use std::io;

use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;

use super::problem::StreamProblem;
use crate::service::SessionPolicy;
use etude_core::attribute::{ByAttribute, Scalar};
use etude_core::document::{Faults, Place};
use etude_core::mapping::{CommittedStep, Cost, MoveKind, PolicyEnd, Status, Step, Warning};

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
    /// What a frame of observed states has.
    pub(super) const OBSERVE_FIELDS: &'static [&'static str] = &["type", "seq", "states", "observation_weights"];

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
                root.object(Self::OBSERVE_FIELDS, faults)?;
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
                Some(Self::Reward { reward: reward.number(etude_core::document::Range::Finite, faults)? })
            }
            _ => kind.mismatch("one of \"open\", \"observe\", \"end\", \"resume\", \"reward\"", faults),
        }
    }
}

/// What the server sends.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
#[serde(tag = "type", rename_all = "lowercase")]
pub enum ServerFrame<'f> {
    /// The first frame.
    #[schema(title = "HelloFrame")]
    Hello {
        /// The protocol's name.
        protocol: &'static str,
        /// The server's version.
        server: &'static str,
        /// What it takes.
        limits: HelloLimits,
    },
    /// A session is open, or resumed.
    #[schema(title = "OpenedFrame")]
    Opened {
        /// Its id, to resume it by.
        session: &'f str,
        /// The trial that it explores, if any.
        trial: Option<&'f str>,
        /// The weights of the distance.
        #[schema(value_type = BTreeMap<String, f64>)]
        weights: ByAttribute<f64>,
        /// How many observations are durable.
        received: u32,
        /// How many steps were committed.
        steps: usize,
    },
    /// That many observations are durable.
    #[schema(title = "ReceivedFrame")]
    Received {
        /// How many.
        seq: u32,
        /// What there is to warn of for the first time; left out if there is nothing. Places are those in the frame that was received.
        #[serde(skip_serializing_if = "<[_]>::is_empty")]
        #[schema(required = false)]
        warnings: &'f [Warning],
    },
    /// A step that will not be revised.
    #[schema(title = "StepFrame")]
    Step(StepFrame<'f>),
    /// The policy of the whole demonstration is stored.
    #[schema(title = "DoneFrame")]
    Done {
        /// Its id; `None` once it was deleted.
        policy_id: Option<&'f str>,
        /// What was proven of it.
        status: Status,
        /// What it costs.
        cost: Cost,
        /// How it ends: whether it succeeded.
        end: &'f PolicyEnd,
        /// What was observed and can hardly be meant, each kind once for an attribute. Places are those in all states of the session.
        warnings: &'f [Warning],
        /// Its actions, in order; `None` where they are left out, as the frame would be too long.
        #[serde(skip_serializing_if = "Option::is_none")]
        #[schema(value_type = Vec<String>, required = false)]
        actions: Option<&'f [std::sync::Arc<str>]>,
    },
    /// The reward of the explored trial is durable.
    #[schema(title = "RewardedFrame")]
    Rewarded {
        /// The trial.
        trial: &'f str,
        /// Its reward.
        reward: f64,
        /// The order in which its learner accepted it.
        reward_order: Option<u64>,
    },
    /// Something is wrong.
    #[schema(title = "ErrorFrame")]
    Error {
        /// What.
        problem: StreamProblem,
    },
}

/// Why a frame could not be written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// It takes more bytes than it may.
    #[error("the frame is too long")]
    TooLong,
    /// It is no JSON: a defect.
    #[error(transparent)]
    Json(serde_json::Error),
}

impl ServerFrame<'_> {
    /// Its JSON, of at most `max_bytes`. Where it would take more, a policy's actions, or faults and warnings beyond the first ones, are left out.
    ///
    /// # Errors
    ///
    /// [`WriteError::TooLong`] if it takes more without these too.
    pub fn text_within(&self, max_bytes: usize) -> Result<String, WriteError> {
        let written = write_within(self, max_bytes);
        match (self, written) {
            (Self::Done { policy_id, status, cost, end, warnings, actions }, Err(WriteError::TooLong))
                if actions.is_some() || !warnings.is_empty() =>
            {
                // Actions first.
                let warnings = if actions.is_some() { warnings } else { &warnings[..warnings.len() / 2] };
                let (policy_id, status, cost) = (*policy_id, *status, *cost);
                Self::Done { policy_id, status, cost, end, warnings, actions: None }.text_within(max_bytes)
            }
            (Self::Received { seq, warnings }, Err(WriteError::TooLong)) if !warnings.is_empty() => {
                Self::Received { seq: *seq, warnings: &warnings[..warnings.len() / 2] }.text_within(max_bytes)
            }
            (Self::Error { problem }, Err(WriteError::TooLong)) if !problem.errors.is_empty() => {
                let errors = problem.errors[..problem.errors.len() / 2].to_vec();
                let problem = StreamProblem { errors, kind: problem.kind.clone(), detail: problem.detail.clone() };
                Self::Error { problem }.text_within(max_bytes)
            }
            (_, written) => written,
        }
    }
}

/// Text that may not grow beyond `max_bytes`.
struct Bounded {
    text: Vec<u8>,
    max_bytes: usize,
}

impl io::Write for Bounded {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.write_all(bytes).map(|()| bytes.len())
    }

    fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        if self.text.len() + bytes.len() > self.max_bytes {
            return Err(io::ErrorKind::FileTooLarge.into());
        }
        self.text.extend_from_slice(bytes);
        Ok(())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn write_within(frame: &ServerFrame<'_>, max_bytes: usize) -> Result<String, WriteError> {
    /// Of most frames.
    const USUAL_BYTES: usize = 256;
    let mut bounded = Bounded { text: Vec::with_capacity(USUAL_BYTES), max_bytes };
    serde_json::to_writer(&mut bounded, frame)
        .map_err(|error| if error.is_io() { WriteError::TooLong } else { WriteError::Json(error) })?;
    // What serde_json writes is UTF-8.
    String::from_utf8(bounded.text).map_err(|error| WriteError::Json(serde::ser::Error::custom(error)))
}

/// What a server takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ToSchema)]
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
    /// How often a client of which nothing comes is asked for a sign of life over a websocket, in milliseconds.
    pub ping_interval_ms: u64,
}

/// A committed step, as in a policy.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct StepFrame<'f> {
    /// Counted from 0.
    step: u32,
    /// The observation that the step belongs to, counted from 0.
    observation: u32,
    /// How it advances.
    #[serde(rename = "move")]
    kind: MoveKind,
    /// The action taken, if any.
    action: Option<&'f str>,
    /// The imitator's state after the step.
    #[schema(value_type = BTreeMap<String, Scalar>)]
    state: &'f ByAttribute<Scalar>,
    /// Cost of the action.
    action_cost: f64,
    /// Weighted distance between the observation and the state.
    distance: f64,
    /// Cost of the steps up to and including this one.
    cost: f64,
    /// Whether it is part of a cheapest mapping, whatever is still to come, among those that begin with the steps before it.
    proven: bool,
    /// How many observations had come when it was committed.
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

impl<'f> From<&'f SessionPolicy> for ServerFrame<'f> {
    fn from(policy: &'f SessionPolicy) -> Self {
        let SessionPolicy { id, status, cost, end, warnings, actions } = policy;
        Self::Done { policy_id: id.as_deref(), status: *status, cost: *cost, end, warnings, actions: Some(actions) }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use etude_core::document::Fault;

    #[test]
    fn a_frame_that_would_be_too_long_leaves_out_what_can_be_had_otherwise() {
        let actions: Vec<Arc<str>> = vec!["forward".into(); 100];
        let cost = Cost { total: 0.0, actions: 0.0, distance: 0.0, end: 0.0 };
        let end = PolicyEnd { distance: 1.0, distance_by_attribute: [("x".into(), 1.0)].into_iter().collect() };
        let done = |actions| ServerFrame::Done {
            policy_id: Some("7"),
            status: Status::Local,
            cost,
            end: &end,
            warnings: &[],
            actions,
        };
        let (done, without) = (done(Some(&actions[..])), done(None));
        let whole = serde_json::to_string(&done).unwrap();
        assert_eq!(done.text_within(whole.len()).unwrap(), whole);
        let shorter = done.text_within(whole.len() - 1).unwrap();
        assert_eq!(shorter, serde_json::to_string(&without).unwrap());
        assert!(matches!(done.text_within(shorter.len() - 1), Err(WriteError::TooLong)));

        let warning = |n| Warning { pointer: format!("/states/{n}/door"), detail: "x".repeat(1000) };
        let warnings: Vec<_> = (0..100).map(warning).collect();
        let received = ServerFrame::Received { seq: 7, warnings: &warnings }.text_within(10_000).unwrap();
        let told: Value = serde_json::from_str(&received).unwrap();
        assert_eq!((&told["seq"], told["warnings"].as_array().unwrap().len()), (&serde_json::json!(7), 6));

        let faults = (0..1000).map(|n| Fault { line: None, pointer: format!("/states/{n}"), detail: "far".to_owned() });
        let problem = StreamProblem { errors: faults.collect(), ..StreamProblem::new("invalid", "1000 faults") };
        let text = ServerFrame::Error { problem: problem.clone() }.text_within(10_000).unwrap();
        let told: Value = serde_json::from_str(&text).unwrap();
        let n_told = told["problem"]["errors"].as_array().unwrap().len();
        assert!((100..250).contains(&n_told) && text.len() <= 10_000, "{n_told} of 1000 in {} bytes", text.len());
        // A single one that is too long.
        let problem = StreamProblem::of("invalid", &Faults::one("x".repeat(10_000), "unknown attribute"));
        let text = ServerFrame::Error { problem }.text_within(10_000).unwrap();
        assert_eq!(text, r#"{"type":"error","problem":{"type":"/problems/invalid","detail":"unknown attribute"}}"#);
    }
}
