//! What is written: verbs, each with its own answer, on their way to the writer and back.

use std::fmt;

use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use sqlx::SqliteConnection;
use tokio::sync::oneshot;

use crate::store::arrivals::Arrivals;
use crate::store::observations::SessionRefusal;
use crate::store::policies::AddPolicies;
use crate::store::statements::Statements;
use crate::store::trials::{NewReward, NewTrial, Opened, RewardAnswer};
use crate::store::{NewObservations, NewSession, SessionEnd, StoreError};

/// Something to be written by itself, whatever else is in the transaction.
pub(in crate::store) trait Verb: fmt::Debug + Send + Sync + 'static {
    /// What became of it.
    type Answer: fmt::Debug + Send + Sync + 'static;

    /// Whether observations that have arrived are brought to their table before it is applied.
    const READS_OBSERVATIONS: bool = false;

    /// How many bytes there are to be written, roughly.
    fn n_bytes(&self) -> usize {
        0
    }

    /// Applies it within a transaction. If that fails, it may be applied once more in another one.
    fn apply(&self, writing: &mut Writing<'_, '_>) -> impl Future<Output = Result<Self::Answer, StoreError>> + Send;
}

/// A transaction that writes.
pub(in crate::store) struct Writing<'w, 's> {
    pub(in crate::store) statements: &'w mut Statements<'s>,
    pub(in crate::store) arrivals: &'w mut Arrivals,
    pub(in crate::store) effects: &'w mut Effects,
    /// Whether no sign of life was written since the start, or since the database was unavailable.
    pub(in crate::store) was_interrupted: bool,
}

impl Writing<'_, '_> {
    /// The connection, once what waits was executed.
    pub(in crate::store) async fn connection(&mut self) -> Result<&mut SqliteConnection, StoreError> {
        self.statements.connection().await
    }
}

/// What a transaction changes, once it is committed, for those who do not read the database.
#[derive(Debug, Default)]
pub(in crate::store) struct Effects {
    /// Whether a sign of life was noted.
    pub(in crate::store) has_noted_life: bool,
    /// Models that were registered, changed or deleted, in order, with their generations.
    pub(in crate::store) changed_models: Vec<(String, u64)>,
}

/// A request to the writer. Those of a kind that comes often are applied all together.
#[derive(Debug)]
pub(super) enum Job {
    Observations(Asked<NewObservations, Result<(), SessionRefusal>>),
    Policies(Asked<AddPolicies, ()>),
    Trial(Asked<Box<NewTrial>, Opened>),
    Session(Asked<Box<NewSession>, Opened>),
    End(Asked<Box<SessionEnd>, Result<(), SessionRefusal>>),
    Reward(Asked<NewReward, RewardAnswer>),
    Other(Box<dyn AnyVerb>),
}

impl Job {
    pub(super) fn n_bytes(&self) -> usize {
        match self {
            Self::Observations(asked) => asked.request.n_bytes(),
            Self::Policies(asked) => asked.request.n_bytes(),
            Self::Trial(asked) => asked.request.n_bytes(),
            Self::Session(asked) => asked.request.n_bytes(),
            Self::End(asked) => asked.request.n_bytes(),
            Self::Reward(_) => 0,
            Self::Other(verb) => verb.n_bytes(),
        }
    }

    /// Tells whoever asked, after the commit: the answer, or why there is none.
    pub(super) fn tell(self, committed: Result<(), StoreError>) {
        match self {
            Self::Observations(asked) => asked.tell(committed),
            Self::Policies(asked) => asked.tell(committed),
            Self::Trial(asked) => asked.tell(committed),
            Self::Session(asked) => asked.tell(committed),
            Self::End(asked) => asked.tell(committed),
            Self::Reward(asked) => asked.tell(committed),
            Self::Other(verb) => verb.tell(committed),
        }
    }
}

/// A request, and the way back to whoever asked.
#[derive(Debug)]
pub(super) struct Asked<R, A> {
    pub(super) request: R,
    /// `None` until the request was applied.
    pub(super) answer: Option<A>,
    asker: oneshot::Sender<Result<A, StoreError>>,
}

impl<R, A> Asked<R, A> {
    pub(super) fn new(request: R) -> (Self, oneshot::Receiver<Result<A, StoreError>>) {
        let (asker, answered) = oneshot::channel();
        (Self { request, answer: None, asker }, answered)
    }

    fn tell(self, committed: Result<(), StoreError>) {
        let answer = committed.map(|()| self.answer.expect("what is committed was applied"));
        // Whoever asked may be gone.
        let _ = self.asker.send(answer);
    }
}

/// A [`Verb`], whatever its answer is.
pub(super) trait AnyVerb: fmt::Debug + Send + Sync {
    fn n_bytes(&self) -> usize;
    fn reads_observations(&self) -> bool;
    fn apply<'a>(&'a mut self, writing: &'a mut Writing<'_, '_>) -> BoxFuture<'a, Result<(), StoreError>>;
    fn tell(self: Box<Self>, committed: Result<(), StoreError>);
}

impl<V: Verb> AnyVerb for Asked<V, V::Answer> {
    fn n_bytes(&self) -> usize {
        self.request.n_bytes()
    }

    fn reads_observations(&self) -> bool {
        V::READS_OBSERVATIONS
    }

    fn apply<'a>(&'a mut self, writing: &'a mut Writing<'_, '_>) -> BoxFuture<'a, Result<(), StoreError>> {
        async {
            self.answer = Some(self.request.apply(writing).await?);
            Ok(())
        }
        .boxed()
    }

    fn tell(self: Box<Self>, committed: Result<(), StoreError>) {
        (*self).tell(committed);
    }
}
