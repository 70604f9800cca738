//! Learners and trials, from outside.
//!
//! This file is longer than 400 lines because it is a list of facts, each of which stands by itself, with few helpers.

use crate::harness::service::{Service, answer, example};
use etude_core::learning::{Distribution, Learner};
use reqwest::Method;
use reqwest::header::{ETAG, IF_NONE_MATCH, LOCATION};
use serde_json::{Value, json};

/// Long enough never to come, so that only `POST learn` learns.
const ONLY_WHEN_TOLD: [&str; 2] = ["--learn-every", "1000h"];

fn gold() -> Value {
    json!({"attributes": ["x", "y", "heading", "gold", "arrows"], "seed": 7})
}

fn trial_request() -> Value {
    json!({"model": "figure-6", "demonstration": example("figure-6/demonstration.json")})
}

/// A service with the world of figure 6 and the learner `gold`.
async fn start(flags: &[&str]) -> Service {
    let service = Service::start(flags).await;
    assert_eq!(service.put("/v1/models/figure-6", &example("figure-6/model.json")).await.0, 201);
    assert_eq!(service.put("/v1/learners/gold", &gold()).await.0, 201);
    service
}

async fn make_trial(service: &Service) -> Value {
    let (status, trial) = service.post("/v1/learners/gold/trials", &trial_request()).await;
    assert_eq!(status, 201, "{trial}");
    trial
}

fn path_of(trial: &Value) -> String {
    format!("/v1/trials/{}", trial["id"].as_str().unwrap())
}

async fn reward(service: &Service, trial: &Value, reward: f64) -> (u16, Value) {
    service.put(&format!("{}/reward", path_of(trial)), &json!({"reward": reward})).await
}

fn pointers(problem: &Value) -> Vec<&str> {
    let errors = problem["errors"].as_array().unwrap();
    errors.iter().map(|error| error["pointer"].as_str().unwrap()).collect()
}

fn kind(answer: &(u16, Value)) -> (u16, &str) {
    (answer.0, answer.1["type"].as_str().unwrap_or_default())
}

/// What a weights answer says, in the form of the core.
fn distribution(weights: &Value) -> Distribution {
    let numbers = |name: &str| {
        weights["weights"].as_array().unwrap().iter().map(|weight| weight[name].as_f64().unwrap()).collect()
    };
    Distribution { mean: numbers("mean"), sd: numbers("sd"), expected_reward: weights["expected_reward"].as_f64() }
}

#[tokio::test]
async fn a_learner_is_registered_read_listed_and_deleted() {
    let service = Service::start(&[]).await;
    let (status, created) = service.put("/v1/learners/gold", &gold()).await;
    assert_eq!(status, 201, "{created}");
    let algorithm = json!({"kind": "srv", "alpha": 0.5, "beta": 0.1, "gamma": 0.99, "sd_min": 0.0});
    assert_eq!((&created["name"], &created["algorithm"]), (&json!("gold"), &algorithm));
    assert_eq!((&created["mean"], &created["expected_reward"]), (&json!(1.0), &Value::Null));

    let mut same = gold();
    same["algorithm"] = algorithm;
    same["sd"] = json!({"x": 1, "y": 1.0});
    assert_eq!(service.put("/v1/learners/gold", &same).await, (200, created.clone()));
    let mut other = gold();
    other["seed"] = json!(8);
    let refused = service.put("/v1/learners/gold", &other).await;
    assert_eq!(kind(&refused), (409, "/problems/conflict"));
    assert!(refused.1["detail"].as_str().unwrap().starts_with("learner \"gold\" exists"), "{}", refused.1);

    assert_eq!(service.get("/v1/learners/gold").await, (200, created));
    service.put("/v1/learners/bronze", &other).await;
    let (_, list) = service.get("/v1/learners?limit=1").await;
    assert_eq!((&list["items"][0]["name"], &list["next"]), (&json!("bronze"), &json!("bronze")));
    let (_, list) = service.get("/v1/learners?limit=1&after=bronze").await;
    assert_eq!((&list["items"][0]["name"], &list["next"]), (&json!("gold"), &Value::Null));

    assert_eq!(service.delete("/v1/learners/gold").await.0, 204);
    assert_eq!(kind(&service.delete("/v1/learners/gold").await), (404, "/problems/unknown-learner"));
    for path in ["", "/weights", "/weights/history", "/trials"] {
        let gone = service.get(&format!("/v1/learners/gold{path}")).await;
        assert_eq!(kind(&gone), (404, "/problems/unknown-learner"), "{path}");
    }
    assert_eq!(kind(&service.post("/v1/learners/gold/learn", &Value::Null).await).0, 404);
    assert_eq!(service.put("/v1/learners/gold", &other).await.0, 201);
}

#[tokio::test]
async fn a_trial_goes_from_drawn_to_learned() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let response = service.send(Method::POST, "/v1/learners/gold/trials", &trial_request()).await;
    let location = response.headers()[LOCATION].to_str().unwrap().to_owned();
    let (status, trial) = answer(response).await;
    assert_eq!((status, &location), (201, &path_of(&trial)), "{trial}");

    // The draw is the one that the definition says.
    let learner = Learner::read(&gold()).unwrap();
    let drawn = learner.draw(learner.initial(), 1);
    let told: Vec<f64> = learner.attributes().iter().map(|name| trial["weights"][&**name].as_f64().unwrap()).collect();
    assert_eq!(told, drawn);
    assert_eq!((&trial["number"], &trial["status"], &trial["learner"]), (&json!(1), &json!("active"), &json!("gold")));
    assert_eq!((&trial["weights_version"], &trial["reward"]), (&json!(0), &Value::Null));
    let policy = &trial["policy"];
    assert_eq!((&policy["id"], &policy["learner"]), (&trial["policy_id"], &json!("gold")));
    assert_eq!((&policy["weights"]["x"], &policy["weights"]["outside"]), (&trial["weights"]["x"], &json!(5.0)));
    assert_eq!(service.get(&location).await, (200, trial.clone()));
    let (_, stored) = service.get(&format!("/v1/policies/{}", trial["policy_id"].as_str().unwrap())).await;
    assert_eq!(&stored, policy);

    let (status, rewarded) = reward(&service, &trial, 974.0).await;
    assert_eq!((status, &rewarded["status"], &rewarded["reward_order"]), (200, &json!("rewarded"), &json!(1)));
    assert_eq!((&rewarded["reward"], &rewarded["policy"]), (&json!(974.0), &Value::Null));
    assert_eq!(reward(&service, &trial, 974.0).await, (200, rewarded));
    assert_eq!(kind(&reward(&service, &trial, 973.0).await), (409, "/problems/already-rewarded"));

    let (status, weights) = service.post("/v1/learners/gold/learn", &Value::Null).await;
    assert_eq!((status, &weights["version"], &weights["trials"]), (200, &json!(1), &json!(1)));
    let mut expected = learner.initial().clone();
    learner.learn(&mut expected, &drawn, 974.0);
    assert!(distribution(&weights).has_bits_of(&expected), "{weights}");
    let (_, learned) = service.get(&location).await;
    assert_eq!((&learned["status"], &learned["learned_version"]), (&json!("learned"), &json!(1)));
    let (_, again) = service.post("/v1/learners/gold/learn", &Value::Null).await;
    assert_eq!(again, weights, "nothing new makes no version");
}

#[tokio::test]
async fn all_faults_of_a_request_for_a_trial_are_told_at_once() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let demonstration = json!([{"x": 0}]);
    for (request, expected) in [
        (json!({"demonstration": [], "lookahead": 0, "q": 2}), vec!["/lookahead", "/model", "/q"]),
        (json!({"model": "zz", "demonstration": demonstration, "q": 2}), vec!["/model", "/q"]),
        (json!({"model": "zz", "demonstration": demonstration, "learner": 1}), vec!["/learner", "/model"]),
        (json!({"model": "figure-6", "demonstration": [{"mood": 1}], "q": 2}), vec!["/demonstration/0/mood", "/q"]),
    ] {
        let (status, problem) = service.post("/v1/learners/gold/trials", &request).await;
        let mut found = pointers(&problem);
        found.sort_unstable();
        assert_eq!((status, found), (422, expected), "{request}");
    }
    let unknown = json!({"model": "zz", "demonstration": demonstration});
    let answer = service.post("/v1/learners/gold/trials", &unknown).await;
    assert_eq!(kind(&answer), (404, "/problems/unknown-model"));
}

#[tokio::test]
async fn a_reward_that_is_too_large_is_refused_for_what_it_is() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let trial = make_trial(&service).await;
    let reward = json!({"reward": 1, "why": "x".repeat(20_000)});
    let (status, problem) = service.put(&format!("{}/reward", path_of(&trial)), &reward).await;
    assert_eq!((status, &problem["type"]), (413, &json!("/problems/too-large")));
    let detail = problem["detail"].as_str().unwrap();
    assert!(detail.contains("16384") && !detail.contains("ETUDE_MAX_BODY_BYTES"), "{detail}");
}

#[tokio::test]
async fn a_learner_that_cannot_be_read_keeps_no_other_from_learning() {
    use sqlx::{ConnectOptions, Connection};
    // First in the table, it comes first.
    let service = Service::start(&["--learn-every", "10ms"]).await;
    assert_eq!(service.put("/v1/learners/broken", &gold()).await.0, 201);
    assert_eq!(service.put("/v1/learners/gold", &gold()).await.0, 201);
    assert_eq!(service.put("/v1/models/figure-6", &example("figure-6/model.json")).await.0, 201);
    let (status, broken) = service.post("/v1/learners/broken/trials", &trial_request()).await;
    assert_eq!(status, 201, "{broken}");
    let path = service.directory.path().join("etude.db");
    let mut database = sqlx::sqlite::SqliteConnectOptions::new().filename(path).connect().await.unwrap();
    let garble = "UPDATE learners SET definition = '{' WHERE name = 'broken'";
    sqlx::query(garble).execute(&mut database).await.unwrap();
    database.close().await.unwrap();

    assert_eq!(reward(&service, &broken, 1.0).await.0, 200);
    let trial = make_trial(&service).await;
    assert_eq!(reward(&service, &trial, 1.0).await.0, 200);
    service.until_status(&path_of(&trial), "learned").await;
    assert_eq!(service.get(&path_of(&broken)).await.1["status"], "rewarded");
}

#[tokio::test]
async fn weights_have_versions_tags_and_a_history() {
    let service = start(&ONLY_WHEN_TOLD).await;
    for n in 0..4 {
        let trial = make_trial(&service).await;
        reward(&service, &trial, f64::from(n)).await;
        service.post("/v1/learners/gold/learn", &Value::Null).await;
    }
    let path = "/v1/learners/gold/weights";
    let response = service.client.get(service.url(path)).send().await.unwrap();
    assert_eq!(response.headers()[ETAG], "\"4\"");
    let (_, last) = answer(response).await;
    for (given, status) in [("\"4\"", 304), ("W/\"4\"", 304), ("\"3\", \"4\"", 304), ("*", 304), ("\"3\"", 200)] {
        let response = service.client.get(service.url(path)).header(IF_NONE_MATCH, given).send().await.unwrap();
        assert_eq!((response.status().as_u16(), &response.headers()[ETAG]), (status, &"\"4\"".parse().unwrap()));
    }
    let mut history = Vec::new();
    let mut query = "?limit=2".to_owned();
    loop {
        let (_, page) = service.get(&format!("{path}/history{query}")).await;
        history.extend(page["items"].as_array().unwrap().clone());
        let Some(next) = page["next"].as_str() else { break };
        query = format!("?limit=2&after={next}");
    }
    let versions: Vec<_> = history.iter().map(|weights| weights["version"].as_u64().unwrap()).collect();
    assert_eq!((versions, history.last()), (vec![0, 1, 2, 3, 4], Some(&last)));
    assert_eq!(service.get(&format!("{path}?version=2")).await, (200, history[2].clone()));
    assert_eq!(kind(&service.get(&format!("{path}?version=5")).await), (404, "/problems/unknown-version"));
    for query in ["?version=-1", "?version=x", "?color=red"] {
        assert_eq!(service.get(&format!("{path}{query}")).await.0, 422, "{query}");
    }
}

#[tokio::test]
async fn the_periodic_learner_folds_all_that_is_pending() {
    let service = start(&["--learn-every", "20ms"]).await;
    let trial = make_trial(&service).await;
    reward(&service, &trial, 5.0).await;
    let learned = service.until_status(&path_of(&trial), "learned").await;
    assert_eq!(learned["learned_version"], 1);
    let (_, weights) = service.get("/v1/learners/gold/weights").await;
    assert_eq!((&weights["version"], &weights["expected_reward"]), (&json!(1), &json!(5.0)));
}

#[tokio::test]
async fn a_failed_trial_takes_no_reward_and_an_expired_one_does() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let mut hasty = gold();
    hasty["lease_s"] = json!(1);
    service.put("/v1/learners/hasty", &hasty).await;
    let (_, expiring) = service.post("/v1/learners/hasty/trials", &trial_request()).await;

    let trial = make_trial(&service).await;
    let fail = format!("{}/fail", path_of(&trial));
    let (status, failed) = service.post(&fail, &json!({"reason": "fell over"})).await;
    assert_eq!((status, &failed["status"], &failed["reason"]), (200, &json!("failed"), &json!("fell over")));
    assert_eq!(service.post(&fail, &json!({"reason": "fell over"})).await, (200, failed));
    assert_eq!(kind(&service.post(&fail, &json!({"reason": "bored"})).await), (409, "/problems/trial-failed"));
    assert_eq!(kind(&reward(&service, &trial, 1.0).await), (409, "/problems/trial-failed"));
    let rewarded = make_trial(&service).await;
    reward(&service, &rewarded, 1.0).await;
    let late = service.post(&format!("{}/fail", path_of(&rewarded)), &json!({"reason": "late"})).await;
    assert_eq!(kind(&late), (409, "/problems/already-rewarded"));
    assert_eq!(pointers(&service.post(&fail, &json!({"reason": 7, "why": 1})).await.1), ["/why", "/reason"]);

    service.until_status(&path_of(&expiring), "expired").await;
    let (_, list) = service.get("/v1/learners/hasty/trials?status=expired").await;
    assert_eq!(list["items"][0]["id"], expiring["id"]);
    let (status, late) = reward(&service, &expiring, 3.0).await;
    assert_eq!((status, &late["status"]), (200, &json!("rewarded")));

    make_trial(&service).await;
    let numbers = async |status: &str| {
        let (_, list) = service.get(&format!("/v1/learners/gold/trials{status}")).await;
        let items = list["items"].as_array().unwrap();
        assert!(items.iter().all(|trial| trial["policy_id"].is_string() && trial["policy"].is_null()));
        items.iter().map(|trial| trial["number"].as_u64().unwrap()).collect::<Vec<_>>()
    };
    assert_eq!(numbers("").await, [1, 2, 3]);
    assert_eq!(numbers("?status=failed").await, [1]);
    assert_eq!(numbers("?status=rewarded").await, [2]);
    assert_eq!(numbers("?status=active").await, [3]);
    service.post("/v1/learners/gold/learn", &Value::Null).await;
    assert_eq!(numbers("?status=learned").await, [2]);
    assert_eq!(numbers("?status=rewarded").await, [0_u64; 0]);
    assert_eq!(numbers("?limit=1&after=1").await, [2]);
    assert_eq!(pointers(&service.get("/v1/learners/gold/trials?status=lost").await.1), ["/status"]);
}

#[tokio::test]
async fn bad_input_gets_a_clear_answer_and_changes_nothing() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let trial = make_trial(&service).await;
    let unknown = service.put("/v1/trials/nothing/reward", &json!({"reward": 1})).await;
    assert_eq!(kind(&unknown), (404, "/problems/unknown-trial"));
    assert_eq!(kind(&service.get("/v1/trials/nothing").await), (404, "/problems/unknown-trial"));

    let path = format!("{}/reward", path_of(&trial));
    let send = async |text: &'static str| {
        let request = service.client.put(service.url(&path)).header("content-type", "application/json");
        answer(request.body(text).send().await.unwrap()).await
    };
    for (text, expected) in [
        (r#"{"reward": NaN}"#, (400, "/problems/malformed-json")),
        (r#"{"reward": 1e999}"#, (422, "/problems/invalid")),
        (r#"{"reward": "much"}"#, (422, "/problems/invalid")),
        (r#"{"reward": null}"#, (422, "/problems/invalid")),
        (r#"{"reward": 1, "bonus": 1}"#, (422, "/problems/invalid")),
        (r"[1]", (422, "/problems/invalid")),
    ] {
        assert_eq!(kind(&send(text).await), expected, "{text}");
    }
    assert_eq!(service.get(&path_of(&trial)).await.1["status"], "active");

    for (definition, pointer) in [
        (json!({"attributes": ["x"], "mean": {"color": 1}}), "/mean/color"),
        (json!({"attributes": ["x"], "sd": -1}), "/sd"),
        (json!({"attributes": ["x"], "algorithm": {"kind": "srv", "gamma": 1.5}}), "/algorithm/gamma"),
        (json!({"attributes": ["x"], "lease_s": 0}), "/lease_s"),
        (json!({"attributes": []}), "/attributes"),
    ] {
        let (status, problem) = service.put("/v1/learners/bad", &definition).await;
        assert_eq!((status, pointers(&problem)), (422, vec![pointer]), "{problem}");
    }
    assert_eq!(service.get("/v1/learners/bad").await.0, 404);

    // A learner of attributes that the model does not have.
    service.put("/v1/learners/colors", &json!({"attributes": ["x", "color"]})).await;
    let (status, problem) = service.post("/v1/learners/colors/trials", &trial_request()).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/model"]), "{problem}");
    let mut request = trial_request();
    request["learner"] = json!("colors");
    let (status, problem) = service.post("/v1/policies", &request).await;
    assert_eq!((status, pointers(&problem)), (422, vec!["/learner"]), "{problem}");
    request["learner"] = json!("nobody");
    assert_eq!(kind(&service.post("/v1/policies", &request).await), (404, "/problems/unknown-learner"));

    // Requests with faults take no number.
    let faulty = json!({"model": "figure-6", "demonstration": [{"color": 1}], "start": -1, "learner": "gold"});
    let (status, problem) = service.post("/v1/learners/gold/trials", &faulty).await;
    let mut found = pointers(&problem);
    found.sort_unstable();
    assert_eq!((status, found), (422, vec!["/demonstration/0/color", "/learner", "/start"]));
    assert_eq!(
        kind(&service.post("/v1/learners/nobody/trials", &trial_request()).await).1,
        "/problems/unknown-learner"
    );
    assert_eq!(make_trial(&service).await["number"], 2);

    // A deleted learner takes its trials along.
    assert_eq!(service.delete("/v1/learners/gold").await.0, 204);
    let orphaned = reward(&service, &trial, 1.0).await;
    assert_eq!(kind(&orphaned), (404, "/problems/unknown-trial"));
    service.put("/v1/learners/gold", &gold()).await;
    assert_eq!(kind(&reward(&service, &trial, 1.0).await), (404, "/problems/unknown-trial"));
    let again = make_trial(&service).await;
    assert_eq!((&again["number"], &again["weights"]), (&json!(1), &trial["weights"]), "a new learner starts anew");
}

#[tokio::test]
async fn policies_use_the_means_of_a_learner_where_a_request_names_no_weight() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let learner = json!({"attributes": ["gold", "x"], "mean": {"gold": 3, "x": 0.5}});
    service.put("/v1/learners/keen", &learner).await;
    let mut request = trial_request();
    request["learner"] = json!("keen");
    request["weights"] = json!({"x": 1});
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &policy["learner"], &policy["weights_version"]), (201, &json!("keen"), &json!(0)));
    let weights = &policy["weights"];
    assert_eq!((&weights["gold"], &weights["x"], &weights["outside"]), (&json!(3.0), &json!(1.0), &json!(5.0)));
    assert_eq!(policy["cost"]["total"], 20.1);
}

/// Rewards race: sent twice each, from many tasks, while the learner learns all the time. The weights are those of the log.
#[tokio::test(flavor = "multi_thread")]
async fn any_interleaving_of_rewards_gives_the_fold_in_their_order() {
    const N_TRIALS: u32 = 120;
    let service = start(&["--learn-every", "3ms"]).await;
    let mut trials = Vec::new();
    for _ in 0..N_TRIALS {
        trials.push(make_trial(&service).await);
    }
    let rewards: Vec<_> = trials
        .iter()
        .zip(0..N_TRIALS)
        .flat_map(|(trial, n)| {
            let reward = f64::from(n * 7919 % 1009) - 0.1 * f64::from(n);
            let send = || {
                let url = service.url(&format!("{}/reward", path_of(trial)));
                service.client.put(url).json(&json!({"reward": reward})).send()
            };
            [tokio::spawn(send()), tokio::spawn(send())]
        })
        .collect();
    for sent in rewards {
        assert_eq!(sent.await.unwrap().unwrap().status(), 200);
    }
    let (_, weights) = service.post("/v1/learners/gold/learn", &Value::Null).await;
    assert_eq!(weights["trials"], N_TRIALS);
    assert!(weights["version"].as_u64().unwrap() >= 1);

    let (_, list) = service.get("/v1/learners/gold/trials?limit=1000").await;
    let mut log: Vec<_> = list["items"].as_array().unwrap().clone();
    log.sort_by_key(|trial| trial["reward_order"].as_u64());
    let orders: Vec<_> = log.iter().map(|trial| trial["reward_order"].as_u64().unwrap()).collect();
    assert_eq!(orders, (1..=u64::from(N_TRIALS)).collect::<Vec<_>>());
    let learner = Learner::read(&gold()).unwrap();
    let mut expected = learner.initial().clone();
    for trial in &log {
        let drawn: Vec<f64> =
            learner.attributes().iter().map(|name| trial["weights"][&**name].as_f64().unwrap()).collect();
        learner.learn(&mut expected, &drawn, trial["reward"].as_f64().unwrap());
    }
    assert!(distribution(&weights).has_bits_of(&expected), "{weights}");
}

#[tokio::test]
async fn draws_and_weights_go_on_after_a_restart() {
    let service = start(&ONLY_WHEN_TOLD).await;
    let first = make_trial(&service).await;
    reward(&service, &first, 100.0).await;
    let pending = make_trial(&service).await;
    let directory = service.stop().await;
    let service = Service::start_in(directory, &["--learn-every", "5ms"]).await;
    assert_eq!(make_trial(&service).await["number"], 3);
    assert_eq!(service.get(&path_of(&pending)).await.1["status"], "active");
    // What was pending before the restart is learned after it.
    service.until_status(&path_of(&first), "learned").await;
    assert_eq!(service.get("/v1/learners/gold/weights").await.1["trials"], 1);
}
