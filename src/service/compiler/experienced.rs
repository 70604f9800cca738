//! Models of experience, made ready.

use std::sync::Arc;

use super::{Asked, Compiler};
use crate::client::Client;
use crate::service::ServiceError;
use crate::service::pool::Admission;
use crate::service::told::Wanted;
use crate::store::ModelKey;
use etude_core::interrupt::Interrupt;
use etude_core::mapping::Mapper;
use etude_core::model::Limits;

impl Compiler {
    /// Makes the model of experience called `name` ready, and puts it into the cache: the revision that there is now, or that is asked for.
    pub(super) async fn make_experienced_ready(
        &self,
        name: &str,
        asked: &Asked,
        place: Option<Admission>,
    ) -> Result<(String, Arc<Mapper>), ServiceError> {
        let wanted = match asked {
            Asked::Exactly(key) => Wanted::Revision(&key.hash),
            Asked::Current(..) => Wanted::Current,
        };
        let (hash, table) = self.experiences.table(name, wanted).await?;
        let Some(table) = table else { return Err(ServiceError::NothingExperienced { model: name.to_owned() }) };
        let compiler = self.clone();
        let job = move |interrupt: &mut dyn Interrupt| {
            Ok(match compiler.take(table.compiling_bytes(Limits::NONE)) {
                Ok(held) => compiler.compile(table, held, Limits::NONE, interrupt),
                Err(no_room) => Err(no_room.into()),
            })
        };
        let mapper = match place {
            Some(place) => place.run(None, job).await,
            None => self.pool.run_in_turn(Client::LOCAL, job).await,
        };
        let mapper = Arc::new(mapper??);
        self.put(ModelKey { hash: hash.clone(), is_lazy: false }, &mapper).await;
        Ok((hash, mapper))
    }

    /// Evicts the revision of a model of experience that had this hash.
    pub(in crate::service) async fn forget(&self, hash: String) {
        let cache = Arc::clone(&self.cache);
        // Off the async threads, as freeing it may take long. It does not fail.
        let forgetting = move || drop(cache.remove(&ModelKey { hash, is_lazy: false }));
        let _ = self.tasks.spawn_blocking(forgetting).await;
    }
}
