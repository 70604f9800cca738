//! What is learned: the paper's experiments, and what survives a kill.

use std::path::Path;
use std::process::Command;

use crate::harness::service::{Service, example};
use etude::experiment::{CurvePlan, Laboratory, Local, Scene, figure_4, figure_7, figure_8};
use etude_core::learning::PerAttributeDocument;
use serde_json::{Value, json};

/// What an imitator earns in `scene` with a given weight of gold.
fn earned(scene: &Scene, gold: Option<f64>) -> f64 {
    let mut laboratory = Local::new();
    let learner = gold.map(|gold| {
        let mut definition = CurvePlan::documented().learner;
        definition.attributes = vec!["gold".into()];
        definition.mean = Some(PerAttributeDocument::All(gold));
        laboratory.start_learner(&definition).unwrap()
    });
    scene.execute(&laboratory.map(scene, learner.as_ref()).unwrap().actions).reward
}

#[test]
fn the_simulator_pays_what_the_paper_s_worlds_pay() {
    assert_eq!((earned(&Scene::figure_6(), None), earned(&Scene::figure_6(), Some(3.0))), (-19.0, 974.0));
    let [l1, ..] = Scene::figure_8();
    assert_eq!((earned(&l1, None), earned(&l1, Some(6.0))), (-15.0, 978.0));
    let paths = figure_4(&mut Local::new()).unwrap();
    assert_eq!((paths.cost, paths.demonstrator.len(), paths.imitator.len()), (48.2, 16, 25));
}

#[test]
fn after_the_last_seed_comes_the_first() {
    let mut plan = CurvePlan { n_runs: 2, n_trials: 1, ..CurvePlan::documented() };
    plan.learner.seed = Some(u64::MAX);
    let curve = figure_7(&mut Local::new(), &plan, || {}).unwrap();
    assert_eq!(curve.runs.iter().map(|run| run.seed).collect::<Vec<_>>(), [u64::MAX, 0]);
}

#[test]
fn a_hundred_learners_learn_to_fetch_the_gold_and_what_they_learned_helps_elsewhere() {
    let plan = CurvePlan { n_runs: 100, ..CurvePlan::documented() };
    let curve = figure_7(&mut Local::new(), &plan, || {}).unwrap();
    let n_good = curve.runs.iter().filter(|run| run.running_average(plan.n_trials) >= 950.0).count();
    assert!(n_good >= 95, "only {n_good} of 100");
    let sd: Vec<f64> = curve.points().map(|point| point.sd).collect();
    assert!(sd[199] < 0.02 * sd[19] && sd[199] < 10.0, "from {} to {}", sd[19], sd[199]);
}

#[test]
fn learned_weights_fetch_the_gold_at_all_four_locations_and_uniform_ones_at_one() {
    let locations = figure_8(&mut Local::new(), &CurvePlan::documented(), || {}).unwrap();
    assert!(locations.rows.iter().all(|row| row.learned >= 950.0), "{locations:?}");
    assert_eq!(locations.rows.iter().filter(|row| row.uniform < 0.0).count(), 3, "{locations:?}");
}

/// A change of these is a change of what every seed learns: review it as one.
#[test]
fn learned_weights_are_pinned() {
    let plan = CurvePlan { n_runs: 1, ..CurvePlan::documented() };
    let curve = figure_7(&mut Local::new(), &plan, || {}).unwrap();
    let expected = [
        ("arrows", 3.405_378_537_974_776_5),
        ("gold", 6.209_503_547_781_036),
        ("heading", 0.333_227_676_749_201_73),
        ("x", 0.397_631_478_109_753_24),
        ("y", 1.124_252_474_443_983_7),
    ];
    assert_eq!(curve.runs[0].means, expected.map(|(name, mean)| (name.to_owned(), mean)).into());
}

#[tokio::test(flavor = "multi_thread")]
async fn an_experiment_gives_the_same_numbers_through_a_service() {
    // Learning also goes on by itself, which must not change anything.
    let service = Service::start(&["--learn-every", "2ms"]).await;
    let directory = tempfile::tempdir().unwrap();
    let run = |out: &Path, server: &[&str]| {
        let options = ["experiment", "all", "--seed", "5", "--runs", "2", "--trials", "25", "--out"];
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        let done = command.args(options).arg(out).args(server).output().unwrap();
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
    };
    let (local, remote) = (directory.path().join("local"), directory.path().join("remote"));
    run(&local, &[]);
    let url = service.url("");
    tokio::task::block_in_place(|| run(&remote, &["--server", &url]));
    for file in ["figure-4.svg", "figure-7.csv", "figure-7.svg", "figure-8.csv", "figure-8.svg", "figure-8.txt"] {
        let read = |directory: &Path| std::fs::read_to_string(directory.join(file)).unwrap();
        assert!(read(&local) == read(&remote), "{file}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_learned_in_one_place_starts_another() {
    let service = Service::start(&["--learn-every", "1000h"]).await;
    service.put("/v1/models/figure-6", &example("figure-6/model.json")).await;
    service.put("/v1/learners/gold", &json!({"attributes": ["x", "gold"], "seed": 3})).await;
    let request = json!({"model": "figure-6", "demonstration": example("figure-6/demonstration.json")});
    for reward in [0.1, -19.3, 974.0] {
        let (_, trial) = service.post("/v1/learners/gold/trials", &request).await;
        let path = format!("/v1/trials/{}/reward", trial["id"].as_str().unwrap());
        service.put(&path, &json!({"reward": reward})).await;
        service.post("/v1/learners/gold/learn", &Value::Null).await;
    }
    let (_, learned) = service.get("/v1/learners/gold/weights").await;
    let url = service.url("");
    let run = |arguments: &[&str]| {
        let done =
            tokio::task::block_in_place(|| Command::new(env!("CARGO_BIN_EXE_etude")).args(arguments).output().unwrap());
        let error = String::from_utf8_lossy(&done.stderr).into_owned();
        (done.status.success(), String::from_utf8_lossy(&done.stdout).into_owned(), error)
    };
    let directory = tempfile::tempdir().unwrap();
    let at = |name: &str| directory.path().join(name).to_str().unwrap().to_owned();
    let (done, text, error) = run(&["learner", "export", "gold", "--server", &url]);
    assert!(done, "{error}");
    std::fs::write(at("gold.json"), &text).unwrap();
    let (done, _, error) = run(&["learner", "import", &at("gold.json"), "--name", "copy", "--server", &url]);
    assert!(done, "{error}");
    let (_, copied) = service.get("/v1/learners/copy/weights").await;
    assert_eq!((&copied["weights"], &copied["version"]), (&learned["weights"], &json!(0)));
    assert_eq!(copied["expected_reward"], learned["expected_reward"]);

    // The same from the database itself, and into another.
    let stopped = service.stop().await;
    let database = stopped.path().join("etude.db");
    let database = database.to_str().unwrap();
    let (done, same, error) = run(&["learner", "export", "gold", "--database", database]);
    assert!(done && same == text, "{error}");
    let (done, told, error) = run(&["learner", "replay", "gold", "--database", database]);
    assert!(done && told.contains("3 rewards give all 4 versions"), "{told}{error}");
    std::fs::write(at("odd.json"), text.replace("etude.learner.v1", "etude.learner.v9")).unwrap();
    let (done, _, error) = run(&["learner", "import", &at("odd.json"), "--database", database]);
    assert!(!done && error.contains("\"format\" is not \"etude.learner.v1\""), "{error}");
    let (done, _, error) = run(&["learner", "replay", "nobody", "--database", database]);
    assert!(!done && error.contains("there is no learner \"nobody\""), "{error}");
    let (done, _, _) = run(&["learner", "replay", "gold", "--database", &at("nowhere.db")]);
    assert!(!done && !Path::new(&at("nowhere.db")).exists());
}
