//! Reports: what inspection finds in a model, and what of a demonstration its body can never meet.

use std::time::Duration;

use serde_json::{Value, json};
use tokio_util::bytes::Bytes;

use super::requests::{check_deadline, n_observations, parse};
use super::search::write;
use super::{Caller, Etude, Kind, Name, ServiceError};
use crate::memory::Held;
use etude_core::document::{Faults, Object, Place};
use etude_core::inspection::{Query, Report, inspect, inspection_bytes};
use etude_core::interrupt::{Cancelled, Interrupt, time_until_finish};
use etude_core::mapping::{Demonstration, Options};
use etude_core::model::Model;

impl Etude {
    /// What inspection finds in the model called `name` (JSON); with a `body` (JSON), also for the demonstration in that. It takes its turn
    /// among searches, and has their deadline: what was not found by then is left out, which the report says.
    ///
    /// # Errors
    ///
    /// If there is no such model, the body is no request, or the service cannot do it now.
    pub async fn report(&self, name: &Name, body: Option<Bytes>, caller: Caller) -> Result<String, ServiceError> {
        let place = self.pool.admit_when_needed(caller.client);
        let is_asked = body.is_some();
        let (request, held) = match body {
            Some(body) => parse(body, &place, &self.memory).await?,
            None => (json!({}), None),
        };
        // What else is wrong with it is told once the model is there.
        let deadline = deadline_of(&request);
        let own_faults = check_deadline(deadline, self.time_limits.max_deadline);
        let deadline = deadline.unwrap_or(self.time_limits.default_deadline);
        let deadline = caller.arrived.checked_add(time_until_finish(deadline));
        let place = place.waiting_until(deadline);
        let known = self.known_mapper(name.as_str(), "", &place, deadline).await;
        let (model_hash, mapper) = known.map_err(|error| match error {
            ServiceError::Unknown { .. } => {
                ServiceError::Unknown { kind: Kind::Model, name: name.to_string(), pointer: None }
            }
            error => error,
        })?;
        let (model_name, memory) = (name.to_string(), self.memory.clone());
        let job = move |interrupt: &mut dyn Interrupt| {
            let (_held, model) = (held, mapper.model());
            let report = || -> Result<Result<String, ServiceError>, Cancelled> {
                let n_observations = n_observations(&request).min(Demonstration::MAX_OBSERVATIONS);
                let n_bytes = inspection_bytes(model) + Demonstration::bytes_of(model.schema(), n_observations);
                let mut held: Option<Held> = None;
                if let Err(no_room) = memory.reserve(&mut held, n_bytes) {
                    return Ok(Err(no_room.into()));
                }
                let query = match read(model, &request, is_asked, own_faults) {
                    Ok(query) => query,
                    Err(faults) => return Ok(Err(faults.into())),
                };
                let report = inspect(model, &query, interrupt)?;
                Ok(write(&Report { model: model_name, model_hash, ..report }))
            };
            report()
        };
        place.run(deadline, job).await?
    }
}

/// The deadline of a request, if it has one, whatever else is wrong with it.
fn deadline_of(request: &Value) -> Option<Duration> {
    let mut faults = Faults::default();
    let alone = json!({"deadline_ms": request.get("deadline_ms")});
    let object = Place::root(&alone).open_object(&mut faults)?;
    Options::read_general(&object, &Options::default(), &mut faults)?.deadline()
}

/// Reads a request for a report, which has a demonstration if it `is_asked` for one. `faults` are those that were found so far.
fn read(model: &Model, request: &Value, is_asked: bool, mut faults: Faults) -> Result<Query, Faults> {
    let object = Place::root(request).object(Query::FIELDS, &mut faults);
    let query = object.and_then(|object: Object<'_, '_>| {
        if is_asked {
            object.required("demonstration", &mut faults);
        }
        Query::read(model, &object, &mut faults)
    });
    faults.check(query)
}

#[cfg(test)]
mod tests {
    use jiff::Timestamp;
    use tokio_util::sync::CancellationToken;
    use tokio_util::task::TaskTracker;

    use super::*;
    use crate::client::Client;
    use crate::clock::Clock;
    use crate::service::{ModelText, Settings};
    use etude_core::model::Format;

    fn caller() -> Caller {
        Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: Timestamp::UNIX_EPOCH }
    }

    #[tokio::test]
    async fn a_report_for_which_there_is_no_memory_is_refused_and_one_that_is_made_gives_it_back() {
        let directory = tempfile::tempdir().unwrap();
        let settings = Settings::of_test(directory.path());
        let etude = Etude::open(&settings, &TaskTracker::new(), CancellationToken::new()).await.unwrap();
        let name = Name::new("m").unwrap();
        let states: Vec<_> = (0..1000).map(|x| json!([x])).collect();
        let model = json!({
            "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on"}],
            "dynamics": {"kind": "table", "states": states, "transitions": [[0, "on", 1]]},
        });
        let text = ModelText::Whole(model.to_string().into_bytes());
        etude.put_model(&name, text, Format::Json, caller()).await.unwrap();
        let large = etude.memory.try_take(etude.memory.free_for_large()).unwrap();
        let small: Vec<_> = std::iter::from_fn(|| etude.memory.try_take(1 << 16).ok()).collect();
        let refused = etude.report(&name, None, caller()).await;
        assert!(matches!(refused, Err(ServiceError::NoRoom(_))), "{refused:?}");
        drop((large, small));
        let free = etude.memory.free();
        let report: Value = serde_json::from_str(&etude.report(&name, None, caller()).await.unwrap()).unwrap();
        assert_eq!(report["reach"]["states"], 1000);
        assert_eq!(etude.memory.free(), free);
    }
}
