//! What is read and could be meant otherwise: outcomes, values that no state has, observations that repeat themselves.

use serde_json::{Value, json};

use super::{line, pointers, stream};
use crate::harness::service::Service;

#[tokio::test]
async fn a_model_of_several_outcomes_is_kept_and_refused_where_it_would_be_searched() {
    let service = Service::start(&[]).await;
    let mut slippery = line();
    slippery["dynamics"]["transitions"] =
        json!([[0, "on", 1, 0.9, 2.5], [0, "on", 0, 0.1], [1, "on", 2, 1, 0.5], [2, "back", 1]]);
    let (status, made) = service.put("/v1/models/slippery", &slippery).await;
    assert_eq!(
        (status, &made["counts"]["stochastic"], &made["counts"]["transitions"]),
        (201, &json!(1), &json!(4)),
        "{made}"
    );
    let (_, read) = service.get("/v1/models/slippery").await;
    let written = json!([[0, "on", 1, 0.9, 2.5], [0, "on", 0, 0.1], [1, "on", 2, 1.0, 0.5], [2, "back", 1]]);
    assert_eq!((&read["definition"]["dynamics"]["transitions"], &read["counts"]), (&written, &made["counts"]));
    assert_eq!(service.put("/v1/models/slippery", &read["definition"]).await.0, 200);
    let (_, page) = service.get("/v1/models").await;
    assert_eq!(page["items"][0]["counts"], made["counts"]);
    for other in
        [json!([[0, "on", 1, 0.9], [0, "on", 0, 0.1], [1, "on", 2, 1, 0.5], [2, "back", 1]]), json!([[0, "on", 1]])]
    {
        let mut model = slippery.clone();
        model["dynamics"]["transitions"] = other;
        let (_, made_otherwise) = service.put("/v1/models/other", &model).await;
        assert_ne!(made_otherwise["hash"], made["hash"]);
        service.delete("/v1/models/other").await;
    }

    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    let demonstration = json!([{"x": 0}, {"x": 2}]);
    let request = json!({"model": "slippery", "demonstration": demonstration});
    let batch = json!({"model": "slippery", "items": [{"demonstration": demonstration}]});
    for (path, body) in [("policies", &request), ("policies:batch", &batch), ("learners/l/trials", &request)] {
        let (status, problem) = service.post(&format!("/v1/{path}"), body).await;
        let [fault] = &problem["errors"].as_array().unwrap()[..] else { panic!("{problem}") };
        assert_eq!((status, &fault["pointer"]), (422, &json!("/model")), "{path}: {problem}");
        assert!(fault["detail"].as_str().unwrap().starts_with("this model is stochastic"), "{path}: {problem}");
    }
    let frames = stream(&service, &[json!({"type": "open", "model": "slippery"})]).await;
    let told = &frames[1]["problem"]["errors"][0];
    assert!(told["pointer"] == "/model" && told["detail"].as_str().unwrap().contains("stochastic"), "{frames:?}");
    service.stop().await;
}

#[tokio::test]
async fn policies_warn_of_what_can_hardly_be_meant_and_keep_it() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    let odd = json!([{"x": 0, "door": "Open"}, {"x": 2, "door": "shut"}]);
    let request = json!({"model": "line", "demonstration": odd});
    let at = |pointer: &str| {
        json!([{
            "pointer": pointer,
            "detail": "no state has \"Open\": it differs from all of them alike; is \"open\" meant? (in 1 observation)",
        }])
    };
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &policy["warnings"]), (201, &at("/demonstration/0/door")), "{policy}");
    let (_, read) = service.get(&format!("/v1/policies/{}", policy["id"].as_str().unwrap())).await;
    assert_eq!(read, policy);
    let (_, trial) = service.post("/v1/learners/l/trials", &request).await;
    assert_eq!(trial["policy"]["warnings"], at("/demonstration/0/door"), "{trial}");
    let right = json!([{"x": 0, "door": "open"}]);
    let batch = json!({"model": "line", "items": [{"demonstration": right}, {"demonstration": odd}]});
    let (_, answers) = service.post("/v1/policies:batch", &batch).await;
    let warnings: Vec<_> = answers["items"].as_array().unwrap().iter().map(|item| &item["warnings"]).collect();
    assert_eq!(warnings, [&json!([]), &at("/items/1/demonstration/0/door")], "{answers}");
    // The answer is the same as if nothing had been said.
    let told_of = json!({"model": "line", "demonstration": [{"x": 0, "door": "ajar"}, {"x": 2, "door": "shut"}]});
    assert_eq!(service.post("/v1/policies", &told_of).await.1["steps"], policy["steps"]);
    service.stop().await;
}

#[tokio::test]
async fn what_repeats_itself_is_left_out_where_a_request_says_so() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    service.put("/v1/learners/l", &json!({"attributes": ["x"]})).await;
    // Of ten observations, those at 0, 5 and 9 are kept.
    let seen: Vec<Value> =
        (0..10).map(|n| json!({"x": f64::from(n / 5) + 0.01 * f64::from(n), "door": "open"})).collect();
    let mut request =
        json!({"model": "line", "demonstration": seen, "observation_weights": [1, 9, 9, 9, 9, 2, 9, 9, 9, 3]});
    let collapse = json!({"x": 0.5});
    request["collapse"] = collapse.clone();
    let (status, policy) = service.post("/v1/policies", &request).await;
    let observations: Vec<_> =
        policy["steps"].as_array().unwrap().iter().map(|step| step["observation"].as_u64().unwrap()).collect();
    assert_eq!((status, observations), (201, vec![0, 5, 9]), "{policy}");
    assert_eq!(policy["coverage"]["observed"], 3);
    let alone = json!({
        "model": "line", "demonstration": [seen[0], seen[5], seen[9]], "observation_weights": [1, 2, 3],
    });
    let (_, alone) = service.post("/v1/policies", &alone).await;
    assert_eq!((&alone["cost"], &alone["end"]), (&policy["cost"], &policy["end"]));
    let (_, read) = service.get(&format!("/v1/policies/{}", policy["id"].as_str().unwrap())).await;
    assert_eq!(read, policy);

    // Likewise in a batch, by all items or by one, and as it is refined.
    let batch = json!({"model": "line", "collapse": collapse, "items": [{"demonstration": seen}, {"demonstration": seen, "collapse": {}}]});
    let (_, answers) = service.post("/v1/policies:batch", &batch).await;
    let n_observed = |n: usize| answers["items"][n]["coverage"]["observed"].as_u64().unwrap();
    assert_eq!((n_observed(0), n_observed(1)), (3, 10), "{answers}");
    request["lookahead"] = json!(1);
    let (_, local) = service.post("/v1/policies", &request).await;
    if local["status"] == "local" {
        let refined = service.refined(local["id"].as_str().unwrap()).await;
        assert_eq!((&refined["cost"], &refined["coverage"]), (&policy["cost"], &policy["coverage"]));
    }
    // A warning leads to where the value stands in what was sent.
    let odd =
        json!({"model": "line", "collapse": {"x": 9}, "demonstration": [{"x": 0}, {"x": 1}, {"door": "ajar"}, {}]});
    let (_, warned) = service.post("/v1/policies", &odd).await;
    assert_eq!(pointers(&warned["warnings"]), ["/demonstration/2/door"], "{warned}");

    for (collapse, pointer) in [
        (json!({"y": 1}), "/collapse/y"),
        (json!({"door": 1}), "/collapse/door"),
        (json!({"x": -1}), "/collapse/x"),
        (json!(0.5), "/collapse"),
    ] {
        request["collapse"] = collapse;
        let (status, problem) = service.post("/v1/policies", &request).await;
        assert_eq!((status, pointers(&problem["errors"])), (422, vec![pointer]), "{problem}");
    }
    let trial = json!({"model": "line", "demonstration": seen, "collapse": {"x": 1}});
    let (status, problem) = service.post("/v1/learners/l/trials", &trial).await;
    assert_eq!((status, pointers(&problem["errors"])), (422, vec!["/collapse"]), "{problem}");
    service.stop().await;
}

#[tokio::test]
async fn streams_warn_when_there_is_something_new_to_say_and_in_the_end_of_all() {
    let service = Service::start(&[]).await;
    service.put("/v1/models/line", &line()).await;
    let observe = |seq: u32, states: Value| json!({"type": "observe", "seq": seq, "states": states});
    let frames = [
        json!({"type": "open", "model": "line"}),
        observe(0, json!([{"x": 0}, {"x": 1, "door": "Open"}])),
        observe(2, json!([{"x": 1, "door": "Open"}])),
        observe(2, json!([{"x": 1, "door": "Open"}, {"x": 2, "door": "Open"}])),
        json!({"type": "end", "seq": 4}),
    ];
    let answered = stream(&service, &frames).await;
    let received: Vec<_> = answered.iter().filter(|frame| frame["type"] == "received").collect();
    assert_eq!(pointers(&received[0]["warnings"]), ["/states/1/door"], "{answered:?}");
    assert_eq!(received[1..].iter().map(|frame| frame.get("warnings")).collect::<Vec<_>>(), [None, None]);
    let done = answered.last().unwrap();
    let told = "no state has \"Open\": it differs from all of them alike; is \"open\" meant? (in 3 observations)";
    assert_eq!(done["warnings"], json!([{"pointer": "/states/1/door", "detail": told}]), "{done}");
    let (_, policy) = service.get(&format!("/v1/policies/{}", done["policy_id"].as_str().unwrap())).await;
    assert_eq!(policy["warnings"], json!([{"pointer": "/demonstration/1/door", "detail": told}]));
    // A session that is taken up again is told the same in the end, and nothing twice before.
    let session = answered[1]["session"].clone();
    let again = stream(&service, &[json!({"type": "resume", "session": session, "step": 0})]).await;
    assert_eq!(again.last().unwrap(), done);

    let opened = stream(&service, &frames[..2]).await;
    let resumed = [
        json!({"type": "resume", "session": opened[1]["session"], "step": 0}),
        frames[2].clone(),
        frames[3].clone(),
        frames[4].clone(),
    ];
    let resumed = stream(&service, &resumed).await;
    assert!(resumed.iter().all(|frame| frame["type"] != "received" || frame.get("warnings").is_none()), "{resumed:?}");
    assert_eq!(resumed.last().unwrap()["warnings"], done["warnings"]);
    service.stop().await;
}

/// A body that may fall: the fall costs much by the transition, not by the action.
#[tokio::test]
async fn a_fall_that_costs_much_is_no_cheap_way_home() {
    let service = Service::start(&[]).await;
    let fall = |from: u32, action: &str| json!([from, action, 0, 1, 100]);
    let cliff = json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "y", "kind": "number"}],
        "actions": [{"name": "right", "cost": 0.3}, {"name": "up", "cost": 0.3}, {"name": "down", "cost": 0.3}],
        "dynamics": {
            "kind": "table", "start": 0,
            "states": [[0, 0], [1, 0], [2, 0], [3, 0], [0, 1], [1, 1], [2, 1], [3, 1]],
            "transitions": [
                fall(0, "right"), [0, "up", 4], [4, "right", 5], [5, "right", 6], [6, "right", 7], [7, "down", 3],
                fall(5, "down"), fall(6, "down"),
            ],
        },
    });
    assert_eq!(service.put("/v1/models/cliff", &cliff).await.0, 201);
    let mut request =
        json!({"model": "cliff", "demonstration": [{"x": 0, "y": 0}, {"x": 3, "y": 0}], "extra_weight": 0});
    let (_, policy) = service.post("/v1/policies", &request).await;
    let last = policy["steps"].as_array().unwrap().last().unwrap();
    assert_eq!((&policy["cost"]["total"], &last["state"]), (&json!(1.5), &json!({"x": 3, "y": 0})), "{policy}");
    // From above and back to the start, it falls, as there is no other way; the fall is what it pays for.
    request["start"] = json!({"x": 1, "y": 1});
    request["demonstration"] = json!([{"x": 1, "y": 1}, {"x": 0, "y": 0}]);
    request["weights"] = json!({"x": 1000, "y": 1000});
    let (_, policy) = service.post("/v1/policies", &request).await;
    assert_eq!(
        (&policy["cost"]["actions"], &policy["steps"][1]["action_cost"]),
        (&json!(100.0), &json!(100.0)),
        "{policy}"
    );
    service.stop().await;
}
