//! What OpenAPI says of the frames that a client sends.

use serde::Serialize;
use utoipa::ToSchema;

use crate::http::requests::OpenFrame;
use etude_core::mapping::ObservationDocument;

/// What a client sends over a stream.
#[derive(Serialize, ToSchema)]
#[serde(tag = "type", rename_all = "lowercase")]
#[schema(as = ClientFrame)]
#[expect(dead_code, reason = "what describes frames, which the session reads")]
pub(in crate::http) enum ClientFrameDocument {
    /// Open a session.
    #[schema(title = "OpenFrame")]
    Open(OpenFrame),
    /// What was observed.
    #[schema(title = "ObserveFrame")]
    Observe {
        /// Index of the first state in this frame. Those that were received before are ignored; a gap is an error.
        seq: u32,
        /// Observed states: objects, or arrays in attribute order.
        states: Vec<ObservationDocument>,
        /// The weight of each of these, at least 0, as many as there are states; `null`, or left out: as `open` says.
        observation_weights: Option<Vec<Option<f64>>>,
    },
    /// The demonstration has ended.
    #[schema(title = "EndFrame")]
    End {
        /// How many observations it has.
        seq: u32,
    },
    /// Take up a session again, after a lost connection or a restart of the server.
    #[schema(title = "ResumeFrame")]
    Resume {
        /// Its id, as `opened` told it.
        session: String,
        /// The first step that is to be sent again; 0 if left out.
        #[serde(default)]
        step: u32,
    },
    /// What the execution of an exploring session's policy earned.
    #[schema(title = "RewardFrame")]
    Reward {
        /// Finite.
        reward: f64,
    },
}
