//! Models that are sent compressed, in lines, or are too large to be held as text.

use std::io::Write;

use crate::harness::service::{Service, answer, example};
use flate2::Compression;
use flate2::write::GzEncoder;
use reqwest::header::{ACCEPT_ENCODING, CONTENT_ENCODING, CONTENT_TYPE};
use reqwest::{Body, Method};
use serde_json::{Value, json};

const JSON: &str = "application/json";
/// So many states that a ring of them is stored in pieces, and read as it comes, compressed or not.
const N_LARGE: u32 = 25_000;

const NDJSON: &str = "application/x-ndjson";

/// A ring of `n` states, each with a name that does not compress well, that a body can walk around both ways.
fn ring(n: u32) -> Value {
    let noise = |x: u32| (1..21).map(move |k| format!("{:08x}", (x * 20 + k).wrapping_mul(2_654_435_761)));
    let states: Vec<Value> = (0..n).map(|x| json!([x, noise(x).collect::<String>()])).collect();
    let steps = |x: u32| [json!([x, "on", (x + 1) % n]), json!([x, "back", (x + n - 1) % n])];
    let transitions: Vec<Value> = (0..n).flat_map(steps).collect();
    json!({
        "attributes": [{"name": "x", "kind": "number"}, {"name": "name", "kind": "category", "weight": 0}],
        "actions": [{"name": "on"}, {"name": "back", "cost": 0.5}],
        "dynamics": {"kind": "table", "states": states, "transitions": transitions, "start": 0},
    })
}

/// The model as lines: itself without its lists, then those in chunks of `n`, those of transitions first.
fn lines_of(model: &Value, n: usize) -> String {
    let mut head = model.clone();
    let dynamics = head["dynamics"].as_object_mut().unwrap();
    let lists = ["transitions", "states"].map(|name| (name, dynamics.remove(name).unwrap()));
    let mut text = format!("{head}\n");
    for (name, list) in lists {
        for chunk in list.as_array().unwrap().chunks(n) {
            text.extend([json!({name: chunk}).to_string(), "\n".to_owned()]);
        }
    }
    text
}

fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = GzEncoder::new(Vec::new(), Compression::fast());
    encoder.write_all(bytes).unwrap();
    encoder.finish().unwrap()
}

fn zstd(bytes: &[u8]) -> Vec<u8> {
    zstd::bulk::compress(bytes, 1).unwrap()
}

/// Registers what is in `body` as it is.
async fn put(
    service: &Service,
    name: &str,
    content_type: &str,
    encoding: Option<&str>,
    body: impl Into<Body>,
) -> (u16, Value) {
    let request = service.client.put(service.url(&format!("/v1/models/{name}"))).header(CONTENT_TYPE, content_type);
    let request = match encoding {
        Some(encoding) => request.header(CONTENT_ENCODING, encoding),
        None => request,
    };
    answer(request.body(body).send().await.unwrap()).await
}

/// The body in chunks, so that its length is not announced.
fn streamed(bytes: &[u8]) -> Body {
    let chunks: Vec<std::io::Result<Vec<u8>>> = bytes.chunks(10_000).map(|chunk| Ok(chunk.to_vec())).collect();
    Body::wrap_stream(futures_util::stream::iter(chunks))
}

/// Lines, or pointers, of a 422.
fn places(problem: &Value) -> Vec<(Option<u64>, &str)> {
    let errors = problem["errors"].as_array().unwrap_or_else(|| panic!("{problem}"));
    errors.iter().map(|error| (error["line"].as_u64(), error["pointer"].as_str().unwrap())).collect()
}

#[tokio::test]
async fn the_same_model_has_the_same_hash_however_it_is_sent() {
    let service = Service::start(&[]).await;
    for (name, n, n_each) in [("small", 5, 2), ("large", N_LARGE, 1000)] {
        let model = ring(n);
        let (json, lines) = (model.to_string(), lines_of(&model, n_each));
        let (status, plain) = put(&service, name, JSON, None, json.clone()).await;
        assert_eq!((status, &plain["counts"]["transitions"]), (201, &json!(2 * n)), "{plain}");
        for (content_type, text) in [(JSON, json.as_bytes()), (NDJSON, lines.as_bytes())] {
            let encoded = [(None, text.to_vec()), (Some("gzip"), gzip(text)), (Some("zstd"), zstd(text))];
            for (encoding, body) in encoded {
                let case = format!("{name} {content_type} {encoding:?}");
                assert_eq!(
                    put(&service, name, content_type, encoding, body.clone()).await,
                    (200, plain.clone()),
                    "{case}"
                );
                let copy = format!("{name}-copy");
                let (status, created) = put(&service, &copy, content_type, encoding, streamed(&body)).await;
                assert_eq!((status, &created["hash"]), (201, &plain["hash"]), "{case}");
                assert_eq!(service.delete(&format!("/v1/models/{copy}")).await.0, 204);
            }
        }
        // What is read back gives the same again, and other content is told apart.
        let (status, whole) = service.get(&format!("/v1/models/{name}")).await;
        assert_eq!((status, &whole["hash"]), (200, &plain["hash"]));
        let (status, again) = put(&service, name, JSON, None, whole["definition"].to_string()).await;
        assert_eq!((status, &again), (200, &plain));
        assert_eq!(put(&service, name, NDJSON, Some("zstd"), zstd(lines.as_bytes())).await, (200, plain));
        let mut other = model;
        other["actions"][1]["cost"] = json!(0.25);
        let (status, problem) = put(&service, name, JSON, None, other.to_string()).await;
        assert_eq!((status, &problem["type"]), (409, &json!("/problems/conflict")));
    }
}

#[tokio::test]
async fn a_model_in_pieces_is_compiled_anew_after_a_restart() {
    let service = Service::start(&[]).await;
    let lines = lines_of(&ring(N_LARGE), 1000);
    assert_eq!(put(&service, "ring", NDJSON, Some("zstd"), zstd(lines.as_bytes())).await.0, 201);
    let request = json!({"model": "ring", "demonstration": [{"x": 0}, {"x": 1}, {"x": 2}, {"x": 3}], "start": 0, "weights": {"x": 4}});
    let (status, before) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &before["actions"]), (201, &json!(["on", "on", "on"])), "{before}");
    let service = Service::start_in(service.stop().await, &[]).await;
    let (status, after) = service.post("/v1/policies", &request).await;
    assert_eq!((status, &after["steps"]), (201, &before["steps"]));
}

#[tokio::test]
async fn every_body_may_be_compressed() {
    let service = Service::start(&[]).await;
    let send = async |encoding: &str, method: Method, path: &str, body: &Value| {
        let text = body.to_string();
        let packed = if encoding == "gzip" { gzip(text.as_bytes()) } else { zstd(text.as_bytes()) };
        let sent = service.client.request(method, service.url(path)).header(CONTENT_TYPE, JSON);
        answer(sent.header(CONTENT_ENCODING, encoding).body(packed).send().await.unwrap()).await
    };
    let request = example("figure-4/request.json");
    let demonstration = &request["demonstration"];
    for encoding in ["gzip", "zstd"] {
        let (model, learner) = (format!("model-{encoding}"), format!("learner-{encoding}"));
        let put = async |path: &str, body: &Value| send(encoding, Method::PUT, path, body).await;
        let post = async |path: &str, body: &Value| send(encoding, Method::POST, path, body).await;
        let (status, put_model) = put(&format!("/v1/models/{model}"), &example("figure-4/model.json")).await;
        assert_eq!(status, 201, "{put_model}");
        let request = json!({"model": model, "demonstration": demonstration});
        let (status, policy) = post("/v1/policies", &request).await;
        assert_eq!((status, &policy["cost"]["total"]), (201, &json!(48.2)), "{policy}");
        let batch = json!({"model": model, "items": [{"demonstration": demonstration}]});
        let (status, policies) = post("/v1/policies:batch", &batch).await;
        assert_eq!((status, &policies["items"][0]["cost"]["total"]), (200, &json!(48.2)), "{policies}");
        let (status, put_learner) = put(&format!("/v1/learners/{learner}"), &json!({"attributes": ["x", "y"]})).await;
        assert_eq!(status, 201, "{put_learner}");
        let mut trials = Vec::new();
        for _ in 0..2 {
            let (status, trial) = post(&format!("/v1/learners/{learner}/trials"), &request).await;
            assert_eq!(status, 201, "{trial}");
            trials.push(format!("/v1/trials/{}", trial["id"].as_str().unwrap()));
        }
        let (status, rewarded) = put(&format!("{}/reward", trials[0]), &json!({"reward": 974})).await;
        assert_eq!((status, &rewarded["reward"]), (200, &json!(974.0)), "{rewarded}");
        let (status, failed) = post(&format!("{}/fail", trials[1]), &json!({"reason": "dark"})).await;
        assert_eq!((status, &failed["reason"]), (200, &json!("dark")), "{failed}");
    }
}

#[tokio::test]
async fn faults_of_lines_carry_the_line_and_the_pointer_within_it() {
    let service = Service::start(&[]).await;
    let lines = concat!(
        r#"{"attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on", "cost": -1}], "#,
        r#""dynamics": {"kind": "table", "states": [[0]], "unsafe": [9], "speed": 1}}"#,
        "\n",
        r#"{"transitions": [[0, "on", 1], [0, "off", 1]]}"#,
        "\n\n",
        r#"{"states": [["far"], [1]], "transitions": [[7, "on", 0]]}"#,
        "\n",
        r#"{"states": [[2]]}"#,
        "\n",
        r#"{"states": [[3, 4]]}"#,
        "\n",
        r#"{"states": 5, "start": 0}"#,
        "\n",
        "[]",
    );
    let (status, problem) = put(&service, "m", NDJSON, None, lines).await;
    assert_eq!(status, 422, "{problem}");
    let mut found = places(&problem);
    found.sort_unstable();
    assert_eq!(
        found,
        [
            (Some(1), "/actions/0/cost"),
            (Some(1), "/dynamics/speed"),
            (Some(1), "/dynamics/unsafe/0"),
            (Some(2), "/transitions/1/1"),
            (Some(4), "/states/0/0"),
            (Some(4), "/transitions/0/0"),
            (Some(6), "/states/0"),
            (Some(7), "/start"),
            (Some(7), "/states"),
            (Some(8), ""),
        ]
    );
    let (status, problem) = put(&service, "m", NDJSON, None, "\n{\"attributes\": []}\n{\"states\": [1,]}").await;
    assert_eq!(status, 400);
    assert!(problem["detail"].as_str().unwrap().starts_with("not JSON at line 3, column 15"), "{problem}");
    let beyond = "{\"dynamics\": {}}\n{\"states\": [[0], [0, 1e999]]}";
    let (status, problem) = put(&service, "m", NDJSON, None, beyond).await;
    assert_eq!((status, places(&problem)), (422, vec![(Some(2), "/states/1/1")]));
    assert_eq!(put(&service, "m", NDJSON, None, "\n\n").await.0, 400, "there is no model");
}

#[tokio::test]
async fn faults_of_a_model_that_is_read_as_it_comes_keep_their_pointers() {
    let service = Service::start(&[]).await;
    let mut model = ring(N_LARGE);
    model["dynamics"]["states"][20_001][0] = json!("far");
    model["dynamics"]["transitions"][40_000] = json!([1, "fly", N_LARGE]);
    model["dynamics"]["transitions"][40_001] = json!([1, "on", 3]);
    for encoding in [None, Some("gzip")] {
        let text = model.to_string();
        let body = if encoding.is_some() { gzip(text.as_bytes()) } else { text.into_bytes() };
        let (status, problem) = put(&service, "m", JSON, encoding, streamed(&body)).await;
        let expected = [
            "/dynamics/states/20001/0",
            "/dynamics/transitions/40000/1",
            "/dynamics/transitions/40000/2",
            "/dynamics/transitions/40001",
        ];
        assert_eq!((status, places(&problem)), (422, expected.map(|pointer| (None, pointer)).to_vec()));
        let details: Vec<_> =
            problem["errors"].as_array().unwrap().iter().map(|error| error["detail"].as_str().unwrap()).collect();
        assert_eq!(
            details,
            [
                "expected a number, found \"far\"",
                "expected one of the actions \"on\", \"back\", found \"fly\"",
                "there is no state 25000: there are 25000, counted from 0",
                "state 1 has a transition by this action already: transition 2; an action with several outcomes needs their \
                 probabilities: [from, action, to, probability]",
            ]
        );
    }
    assert_eq!(service.get("/v1/models").await.1["items"], json!([]), "nothing was registered");
}

#[tokio::test]
async fn limits_hold_for_what_is_sent_and_for_what_comes_out_of_it() {
    let service =
        Service::start(&["--max-body-bytes", "3000000", "--max-model-text-bytes", "4000000", "--max-transitions", "9"])
            .await;
    let (status, problem) = put(&service, "m", JSON, None, ring(5).to_string()).await;
    assert_eq!((status, places(&problem)), (422, vec![(None, "/dynamics/transitions")]));
    // Over the limit by far once it is decompressed.
    let spaces = vec![b' '; 1 << 25];
    for (encoding, body) in [("zstd", zstd(&spaces)), ("gzip", gzip(&spaces))] {
        let (status, problem) = put(&service, "m", JSON, Some(encoding), body.clone()).await;
        assert_eq!((status, &problem["type"]), (413, &json!("/problems/too-large")), "{encoding}: {problem}");
        assert!(problem["detail"].as_str().unwrap().contains("ETUDE_MAX_MODEL_TEXT_BYTES"), "{problem}");
        let sent = service.client.post(service.url("/v1/policies")).header(CONTENT_TYPE, JSON);
        let response = sent.header(CONTENT_ENCODING, encoding).body(body).send().await.unwrap();
        assert_eq!(response.status().as_u16(), 413);
    }
    // More than is at hand at once, and more than may be sent.
    let noise: Vec<String> = (0u32..500_000).map(|n| format!("{:08x}", n.wrapping_mul(2_654_435_761))).collect();
    let noise = format!("\"{}\"", noise.concat()).into_bytes();
    for (encoding, body) in [(None, vec![b' '; 3_500_000]), (Some("zstd"), zstd(&noise))] {
        let (status, problem) = put(&service, "m", JSON, encoding, streamed(&body)).await;
        assert_eq!((status, &problem["type"]), (413, &json!("/problems/too-large")), "{problem}");
    }
    assert_eq!(service.get("/v1/models").await.1["items"], json!([]));
}

#[tokio::test]
async fn a_body_that_cannot_be_decompressed_is_refused() {
    const SAS: &str = "application/vnd.fast-downward.sas";
    const UMB: &str = "application/vnd.umb";
    let service = Service::start(&[]).await;
    let text = ring(N_LARGE).to_string();
    for (encoding, whole) in [("gzip", gzip(text.as_bytes())), ("zstd", zstd(text.as_bytes()))] {
        let broken = [whole[..whole.len() / 2].to_vec(), whole[..5].to_vec(), b"plain text, really".to_vec()];
        for body in broken {
            let (status, problem) = put(&service, "m", JSON, Some(encoding), body).await;
            assert_eq!((status, &problem["type"]), (400, &json!("/problems/broken-encoding")), "{problem}");
        }
        let (_, problem) = put(&service, "m", JSON, Some(encoding), whole[..whole.len() / 2].to_vec()).await;
        let expected = format!("compressed data ends early, at byte {}", whole.len() / 2);
        assert_eq!(problem["detail"], expected);
        // So is the file of another tool; what is compressed within it is its own affair.
        let (status, problem) = put(&service, "m", SAS, Some(encoding), whole[..whole.len() / 2].to_vec()).await;
        assert_eq!((status, &problem["type"]), (400, &json!("/problems/broken-encoding")), "{problem}");
        assert_eq!(problem["detail"], expected);
    }
    let (status, problem) = put(&service, "m", UMB, None, gzip(text.as_bytes())[..100].to_vec()).await;
    assert_eq!((status, &problem["type"]), (422, &json!("/problems/invalid")), "{problem}");
    assert_eq!(problem["errors"][0]["detail"], "cannot be decompressed: compressed data ends early, at byte 100");
    // Of gzip, the last bytes are a checksum.
    let mut flipped = gzip(text.as_bytes());
    *flipped.last_mut().unwrap() ^= 1;
    let (status, problem) = put(&service, "m", JSON, Some("gzip"), flipped).await;
    assert_eq!((status, &problem["type"]), (400, &json!("/problems/broken-encoding")), "{problem}");
    for encoding in ["br", "gzip, zstd", "deflate"] {
        let request = service.client.put(service.url("/v1/models/m")).header(CONTENT_TYPE, JSON);
        let response = request.header(CONTENT_ENCODING, encoding).body(text.clone()).send().await.unwrap();
        assert_eq!(response.headers()[ACCEPT_ENCODING], "gzip, zstd");
        let (status, problem) = answer(response).await;
        assert_eq!((status, &problem["type"]), (415, &json!("/problems/unsupported-encoding")));
    }
    assert_eq!(put(&service, "m", JSON, Some("identity"), ring(3).to_string()).await.0, 201);
    // NDJSON is for models alone.
    let request = service.client.request(Method::POST, service.url("/v1/policies")).header(CONTENT_TYPE, NDJSON);
    assert_eq!(request.body("{}").send().await.unwrap().status().as_u16(), 415);
}
