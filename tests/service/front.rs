//! What stands before the contract: hosts, web pages, slow and silent clients, and places for connections.
//!
//! This file is longer than 400 lines because it is a list of facts, each of which stands by itself, with few helpers.

use std::net::SocketAddr;

use crate::harness::process::Process;
use crate::harness::service::{Service, answer, example, long_way, to_and_fro};
use crate::harness::waiting::{until, within};
use futures_util::future::join_all;
use reqwest::Method;
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpSocket, TcpStream};
use tokio_tungstenite::tungstenite;
use tokio_tungstenite::tungstenite::client::IntoClientRequest;

/// Room of the smallest budget of memory: see `Memory::new`.
const BASE_BYTES: u64 = 64 << 20;

/// Sends text as it is on a connection of its own, and reads until that closes.
async fn talk(address: SocketAddr, text: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(text.as_bytes()).await.unwrap();
    read_to_end(&mut stream).await
}

async fn read_to_end(stream: &mut TcpStream) -> String {
    let mut answer = Vec::new();
    // A connection may be closed with something unread.
    let _ = within("the end of the connection", stream.read_to_end(&mut answer)).await;
    String::from_utf8_lossy(&answer).into_owned()
}

/// Sends a request with these header lines, and gives the status and what else was answered.
async fn ask(address: SocketAddr, first_line: &str, headers: &[&str]) -> (u16, String) {
    let headers: String = headers.iter().flat_map(|header| [*header, "\r\n"]).collect();
    let answer = talk(address, &format!("{first_line} HTTP/1.1\r\nconnection: close\r\n{headers}\r\n")).await;
    (status(&answer), answer)
}

fn status(answer: &str) -> u16 {
    answer.split(' ').nth(1).unwrap_or_else(|| panic!("{answer:?}")).parse().unwrap()
}

#[tokio::test]
async fn a_host_that_the_service_is_not_known_by_is_refused() {
    let service = Service::start(&["--allow-host", "etude,Proxy.example:443"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let machine = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap();
    let known =
        ["127.0.0.1", "192.0.2.7:80", "[::1]:8080", "localhost:8080", "app.localhost", "ETUDE:1", "proxy.example."];
    for host in known.into_iter().chain([machine.trim()]) {
        for path in ["/livez", "/v1/models/figure-4"] {
            let (status, answer) = ask(service.address, &format!("GET {path}"), &[&format!("host: {host}")]).await;
            assert_eq!(status, 200, "{host}: {answer}");
        }
    }
    // What a page of this host would do after its name was pointed here.
    for request in ["DELETE /v1/models/figure-4", "GET /v1/models", "GET /livez", "GET /metrics", "GET /nothing"] {
        let (status, answer) = ask(service.address, request, &["host: evil.example"]).await;
        assert_eq!(status, 421, "{request}: {answer}");
        assert!(answer.contains("/problems/unknown-host") && answer.contains("ETUDE_ALLOW_HOST"), "{answer}");
        assert!(answer.contains("x-request-id"), "{answer}");
    }
    assert_eq!(service.get("/v1/models/figure-4").await.0, 200, "it was not deleted");
    for host in ["localhost.evil.example", "127.0.0.1.evil.example", "evillocalhost"] {
        assert_eq!(ask(service.address, "GET /livez", &[&format!("host: {host}")]).await.0, 421, "{host}");
    }
    let open = Service::start(&["--allow-host", "*"]).await;
    assert_eq!(ask(open.address, "GET /livez", &["host: whatever.example"]).await.0, 200);
}

#[tokio::test]
async fn a_request_has_one_host() {
    let service = Service::start(&[]).await;
    for headers in
        [&[][..], &["host: localhost", "host: localhost"], &["host:"], &["host: a b"], &["host: u@localhost"]]
    {
        let (status, answer) = ask(service.address, "GET /livez", headers).await;
        assert_eq!(status, 400, "{headers:?}: {answer}");
        // What is no header at all, the connection refuses.
        assert!(answer.contains("/problems/bad-host"), "{headers:?}: {answer}");
    }
    let old = talk(service.address, "GET /livez HTTP/1.0\r\n\r\n").await;
    assert!(old.contains(" 400 ") && old.contains("/problems/bad-host"), "{old}");
}

#[tokio::test]
async fn a_target_with_a_host_is_checked_as_the_header_is() {
    let service = Service::start(&[]).await;
    let own = format!("http://{}", service.address);
    for (target, host, expected) in [
        (own.as_str(), "localhost", 200),
        ("http://localhost:1", "127.0.0.1", 200),
        ("http://evil.example", "localhost", 421),
        ("http://localhost", "evil.example", 421),
    ] {
        let (status, answer) = ask(service.address, &format!("GET {target}/livez"), &[&format!("host: {host}")]).await;
        assert_eq!(status, expected, "{target} {host}: {answer}");
    }
    // The page is one of the host that is asked for, which is the target's.
    let origin = |origin: &str| format!("origin: {origin}");
    let target = format!("POST {own}/v1/learners/none/learn");
    assert_eq!(ask(service.address, &target, &["host: localhost", &origin(&own)]).await.0, 404);
    assert_eq!(ask(service.address, &target, &["host: localhost", &origin("http://localhost")]).await.0, 403);
}

#[tokio::test]
async fn a_web_page_reaches_only_its_own_service_or_one_that_allows_it() {
    let service = Service::start(&["--allow-origin", "https://app.example:443,http://localhost:3000"]).await;
    let learner = json!({"attributes": ["x"]});
    assert_eq!(service.put("/v1/learners/gold", &learner).await.0, 201);
    let host = format!("host: {}", service.address);
    let own = format!("http://{}", service.address);
    let secure = format!("https://{}", service.address);
    let requests =
        ["POST /v1/learners/gold/learn", "GET /v1/learners/gold", "PUT /v1/trials/t/reward", "DELETE /v1/learners/x"];
    for request in requests {
        for origin in ["http://evil.example", "null", "http://localhost:8080", "https://localhost:3000", ""] {
            let (status, answer) = ask(service.address, request, &[&host, &format!("origin: {origin}")]).await;
            assert_eq!(status, 403, "{request} {origin:?}: {answer}");
            assert!(answer.contains("/problems/foreign-origin") && answer.contains("ETUDE_ALLOW_ORIGIN"), "{answer}");
            assert!(!answer.contains("access-control-allow-origin"), "{answer}");
        }
        for origin in [own.as_str(), &secure, "https://app.example", "http://localhost:3000"] {
            let (status, answer) = ask(service.address, request, &[&host, &format!("origin: {origin}")]).await;
            assert!(![403, 421].contains(&status), "{request} {origin:?}: {answer}");
        }
    }
    let two = ["origin: https://app.example", "origin: https://app.example"];
    assert_eq!(ask(service.address, requests[0], &[&host, two[0], two[1]]).await.0, 403);
    // Without an origin, there is no page, unless the browser says so.
    for (site, request, expected) in [
        ("cross-site", requests[0], 403),
        ("same-site", requests[0], 403),
        ("cross-site", requests[1], 200),
        ("same-origin", requests[0], 200),
        ("none", requests[0], 200),
    ] {
        let (status, answer) = ask(service.address, request, &[&host, &format!("sec-fetch-site: {site}")]).await;
        assert_eq!(status, expected, "{request} {site}: {answer}");
    }
    assert_eq!(service.post("/v1/learners/gold/learn", &Value::Null).await.0, 200);
}

#[tokio::test]
async fn a_stream_is_opened_by_an_own_page_or_an_allowed_one() {
    let service = Service::start(&["--allow-origin", "https://app.example"]).await;
    let own = format!("http://{}", service.address);
    for (origin, expected) in [
        ("http://evil.example", 403),
        ("null", 403),
        ("http://127.0.0.1", 403),
        ("https://app.example", 101),
        (own.as_str(), 101),
    ] {
        let mut request = format!("ws://{}/v1/stream", service.address).into_client_request().unwrap();
        request.headers_mut().insert("origin", origin.parse().unwrap());
        let status = match tokio_tungstenite::connect_async(request).await {
            Ok((_, response)) => response.status().as_u16(),
            Err(tungstenite::Error::Http(response)) => response.status().as_u16(),
            Err(error) => panic!("{error}"),
        };
        assert_eq!(status, expected, "{origin}");
    }
    // As a page can send it without asking, and as an agent does.
    for (content_type, origin, expected) in [
        (Some("text/plain"), None, 415),
        (None, None, 415),
        (Some("application/json"), None, 415),
        (Some("text/plain"), Some("http://evil.example"), 403),
        (Some("application/x-ndjson"), Some("http://evil.example"), 403),
        (Some("application/x-ndjson; charset=utf-8"), None, 200),
        (Some("application/ndjson"), Some(&*own), 200),
        (Some("application/jsonl"), None, 200),
    ] {
        let mut request = service.client.post(service.url("/v1/stream")).body("{}\n");
        for (name, value) in [("content-type", content_type), ("origin", origin)] {
            request = value.into_iter().fold(request, |request, value| request.header(name, value));
        }
        let response = request.send().await.unwrap();
        assert_eq!(response.status().as_u16(), expected, "{content_type:?} {origin:?}");
    }
}

#[tokio::test]
async fn a_browser_is_told_what_an_allowed_page_may_send_and_read() {
    let service = Service::start(&["--allow-origin", "https://app.example"]).await;
    let preflight = async |origin: &str| {
        let request = service.client.request(Method::OPTIONS, service.url("/v1/policies")).header("origin", origin);
        let request = request.header("access-control-request-method", "POST");
        let request = request.header("access-control-request-headers", "content-type,idempotency-key");
        request.header("access-control-request-private-network", "true").send().await.unwrap()
    };
    let answer = preflight("https://app.example").await;
    let header = |name: &str| answer.headers()[name].to_str().unwrap();
    assert_eq!(answer.status(), 200);
    assert_eq!(header("access-control-allow-origin"), "https://app.example");
    assert!(header("access-control-allow-methods").contains("POST"));
    assert_eq!(header("access-control-allow-headers"), "content-type,idempotency-key");
    assert_eq!(header("access-control-allow-private-network"), "true");
    assert_eq!(preflight("https://evil.example").await.status(), 403);

    // Answers, those that are problems too.
    let get = async |path: &str, origin: Option<&str>| {
        let request = service.client.get(service.url(path));
        origin.into_iter().fold(request, |request, origin| request.header("origin", origin)).send().await.unwrap()
    };
    for (path, expected) in [("/v1/models", 200), ("/v1/models/none", 404), ("/v1/models?limit=x", 422)] {
        let answer = get(path, Some("https://app.example")).await;
        assert_eq!(answer.status(), expected);
        assert_eq!(answer.headers()["access-control-allow-origin"], "https://app.example", "{path}");
        let exposed = answer.headers()["access-control-expose-headers"].to_str().unwrap().to_owned();
        for name in ["etag", "location", "retry-after", "x-request-id"] {
            assert!(exposed.contains(name), "{exposed}");
        }
        assert!(answer.headers().get_all("vary").iter().any(|vary| vary.to_str().unwrap().contains("origin")));
        assert!(!get(path, None).await.headers().contains_key("access-control-allow-origin"));
    }
}

#[tokio::test]
async fn what_has_no_body_takes_no_form() {
    let service = Service::start(&[]).await;
    assert_eq!(service.put("/v1/learners/gold", &json!({"attributes": ["x"]})).await.0, 201);
    let send = async |method: Method, path: &str, content_type: &str, body: &'static str| {
        let request = service.client.request(method, service.url(path)).header("content-type", content_type);
        request.body(body).send().await.unwrap().status().as_u16()
    };
    for (method, path) in [
        (Method::POST, "/v1/learners/gold/learn"),
        (Method::DELETE, "/v1/learners/gold"),
        (Method::DELETE, "/v1/models/none"),
    ] {
        for form in ["text/plain", "application/x-www-form-urlencoded", "Multipart/Form-Data; boundary=b"] {
            assert_eq!(send(method.clone(), path, form, "a=b").await, 415, "{path} {form}");
        }
    }
    // Which some clients declare for no body at all.
    let nothing = "application/x-www-form-urlencoded";
    assert_eq!(send(Method::POST, "/v1/learners/gold/learn", nothing, "").await, 200);
    assert_eq!(send(Method::DELETE, "/v1/learners/gold", "application/json", "{}").await, 204);
}

/// A connection on which a request was begun that announces a body and does not send it.
async fn begin(stream: &mut TcpStream, request: &str, headers: &str) {
    let head = format!("{request} HTTP/1.1\r\nhost: localhost\r\ncontent-length: 8000000\r\n{headers}\r\n");
    stream.write_all(head.as_bytes()).await.unwrap();
}

/// Reads until `end` was read.
async fn read_until(stream: &mut TcpStream, end: &str) -> String {
    let mut answer = Vec::new();
    let reading = async {
        while !answer.ends_with(end.as_bytes()) {
            let byte = stream.read_u8().await;
            answer.push(byte.unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&answer))));
        }
    };
    within(&format!("{end:?}"), reading).await;
    String::from_utf8(answer).unwrap()
}

#[tokio::test]
async fn who_sends_what_is_not_wanted_is_answered_at_once() {
    let service = Service::start(&["--max-body-bytes", "1000000"]).await;
    for (request, headers, expected) in [
        ("PUT /v1/models/m", "content-type: text/plain\r\n", 415),
        ("PUT /v1/models/m", "content-type: application/json\r\ncontent-encoding: br\r\n", 415),
        ("PUT /v1/models/m", "content-type: application/json\r\n", 413),
        ("POST /v1/policies", "content-type: text/plain\r\n", 415),
        ("POST /v1/policies", "content-type: application/json\r\n", 413),
        ("PUT /v1/trials/t/reward", "content-type: application/json\r\n", 413),
        ("POST /v1/stream", "content-type: text/plain\r\n", 415),
        ("POST /v1/policies", "origin: http://evil.example\r\n", 403),
    ] {
        let mut stream = TcpStream::connect(service.address).await.unwrap();
        begin(&mut stream, request, headers).await;
        // Slowly, if at all.
        stream.write_all(b"{").await.unwrap();
        let answer = read_until(&mut stream, "}").await;
        assert_eq!(status(&answer), expected, "{request}: {answer}");
    }
    // The rest of what was refused keeps nothing from ending.
    service.stop().await;
}

#[tokio::test]
async fn who_sends_all_of_what_is_not_wanted_may_send_the_next_request() {
    let service = Service::start(&["--max-body-bytes", "1000000"]).await;
    let mut stream = TcpStream::connect(service.address).await.unwrap();
    begin(&mut stream, "PUT /v1/models/m", "content-type: text/plain\r\n").await;
    stream.write_all(&vec![b' '; 8_000_000]).await.unwrap();
    assert_eq!(status(&read_until(&mut stream, "}").await), 415);
    stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n").await.unwrap();
    assert_eq!(status(&read_to_end(&mut stream).await), 200);
}

/// A connection that has begun to send a body which it announces as large.
async fn announcing(address: SocketAddr, body: &[u8]) -> TcpStream {
    let mut stream = TcpStream::connect(address).await.unwrap();
    begin(&mut stream, "POST /v1/policies", "content-type: application/json\r\nexpect: 100-continue\r\n").await;
    // Then the service reads.
    assert!(read_until(&mut stream, "\r\n\r\n").await.contains(" 100 "));
    stream.write_all(body).await.unwrap();
    stream
}

#[tokio::test]
async fn a_body_that_is_announced_takes_no_room_before_it_comes() {
    let directory = tempfile::tempdir().unwrap();
    // In all, they announce more than there are addresses.
    let process = Process::start_within("-v 3000000", &["--listen", "127.0.0.1:0"], &directory.path().join("etude.db"));
    let address: SocketAddr = process.address.parse().unwrap();
    let mut streams = join_all((0..600).map(|_| announcing(address, b"["))).await;
    for stream in &mut streams {
        stream.write_all(b"[").await.unwrap();
    }
    let (status, answer) = ask(address, "GET /readyz", &["host: localhost"]).await;
    assert_eq!(status, 200, "{answer}");
    // They were read: who ends is told what is wrong.
    for stream in &mut streams[..3] {
        stream.shutdown().await.unwrap();
        let answer = read_to_end(stream).await;
        assert!(answer.contains("/problems/incomplete-body"), "{answer}");
    }
    process.kill();
}

#[tokio::test]
async fn bodies_that_do_not_fit_into_the_memory_are_refused_and_others_are_not() {
    let directory = tempfile::tempdir().unwrap();
    let service =
        Service::start_set_up(directory, &[], |config| config.max_memory = Some(BASE_BYTES + (5 << 20))).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    // Almost half of the room each, as room doubles: some of it is for what is small.
    let mut held = [announcing(service.address, b"[").await, announcing(service.address, b"[").await];
    for stream in &mut held {
        stream.write_all(&vec![b' '; 1_200_000]).await.unwrap();
    }
    let large = vec![b' '; 1_200_000];
    let send = async || {
        let request = service.client.post(service.url("/v1/policies")).header("content-type", "application/json");
        answer(request.body(large.clone()).send().await.unwrap()).await
    };
    // Until both were read.
    let are_held = async || (service.measurement("etude_memory_held_bytes").await >= f64::from(4 << 20)).then_some(());
    until("memory for both", are_held).await;
    let (status, problem) = send().await;
    assert_eq!((status, &problem["type"]), (503, &json!("/problems/busy")));
    assert!(problem["detail"].as_str().unwrap().contains("ETUDE_MAX_MEMORY"), "{problem}");
    assert_eq!(service.post("/v1/policies", &example("figure-4/request.json")).await.0, 201, "what is small fits");
    // What they held is given back.
    drop(held);
    until("the memory of both", async || (send().await.0 == 400).then_some(())).await;
    // What comes out of a body counts as what is sent.
    let bomb = zstd::bulk::compress(&vec![b' '; 6 << 20], 1).unwrap();
    let request = service.client.post(service.url("/v1/policies")).header("content-type", "application/json");
    let sent = request.header("content-encoding", "zstd").body(bomb).send().await.unwrap();
    assert_eq!(answer(sent).await.0, 503);
}

/// A connection with a small window, on which `GET path` was sent.
async fn asking(address: SocketAddr, path: &str) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(16 * 1024).unwrap();
    let mut stream = socket.connect(address).await.unwrap();
    stream.write_all(format!("GET {path} HTTP/1.1\r\nhost: localhost\r\n\r\n").as_bytes()).await.unwrap();
    stream
}

#[tokio::test]
async fn who_does_not_read_an_answer_is_closed_and_gives_its_memory_back() {
    // To make it takes more memory than to read it.
    let service = Service::start(&[]).await;
    assert_eq!(service.put("/v1/models/way", &long_way()).await.0, 201);
    let request = json!({"model": "way", "demonstration": to_and_fro(32)});
    let (status, policy) = service.post("/v1/policies", &request).await;
    assert_eq!(status, 201, "{policy}");
    let n_bytes = policy.to_string().len();
    assert!((13 << 20..24 << 20).contains(&n_bytes), "one answer fits and two do not: {n_bytes}");
    let path = format!("/v1/policies/{}", policy["id"].as_str().unwrap());
    drop(policy);
    let directory = service.stop().await;
    let flags = ["--slow-reader-timeout", "300ms"];
    let service =
        Service::start_set_up(directory, &flags, |config| config.max_memory = Some(BASE_BYTES + (24 << 20))).await;

    let mut unread = asking(service.address, &path).await;
    assert_eq!(status_of(&read_until(&mut unread, "\r\n\r\n").await), 200);
    let (status, problem) = service.get(&path).await;
    assert_eq!((status, &problem["type"]), (503, &json!("/problems/busy")), "no room for another");
    // Operators see what is going on, and small answers are given.
    assert_eq!(service.get("/metrics").await.0, 200);
    assert_eq!(service.get("/v1/policies").await.0, 200);
    let is_there = async || (service.get(&path).await.0 == 200).then_some(());
    until("the memory of the unread answer", is_there).await;
    assert!(read_to_end(&mut unread).await.len() < n_bytes, "the answer was cut off");
}

fn status_of(head: &str) -> u16 {
    status(head)
}

/// A connection from another address of this machine.
async fn connect_from(address: &str, to: SocketAddr) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.bind(SocketAddr::new(address.parse().unwrap(), 0)).unwrap();
    socket.connect(to).await.unwrap()
}

/// Sends a request on a connection, and reads its answer.
async fn livez(stream: &mut TcpStream) -> u16 {
    stream.write_all(b"GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").await.unwrap();
    status(&read_until(stream, "\r\n\r\nalive\n").await)
}

/// Makes a connection busy: with a request whose body the service waits for.
async fn make_busy(stream: &mut TcpStream) {
    begin(stream, "POST /v1/policies", "content-type: application/json\r\nexpect: 100-continue\r\n").await;
    assert!(read_until(stream, "\r\n\r\n").await.contains(" 100 "));
}

#[tokio::test]
async fn where_all_places_are_taken_the_one_without_a_request_makes_room() {
    let service = Service::start(&["--max-connections", "16"]).await;
    let mut streams = Vec::new();
    // Of one address as many as it may have, and as many of another as there are places left.
    for n in 0..16 {
        let from = if n < 12 { "127.0.0.1" } else { "127.0.0.2" };
        let mut stream = connect_from(from, service.address).await;
        assert_eq!(livez(&mut stream).await, 200);
        streams.push(stream);
    }
    make_busy(&mut streams[0]).await;
    // The second one has been without a request longest, then the third, which is of the address that has too many.
    let mut newcomer = connect_from("127.0.0.3", service.address).await;
    assert_eq!(livez(&mut newcomer).await, 200);
    assert_eq!(read_to_end(&mut streams[1]).await, "", "it is closed");
    streams.remove(1);
    let mut another = connect_from("127.0.0.1", service.address).await;
    assert_eq!(livez(&mut another).await, 200);
    assert_eq!(read_to_end(&mut streams[1]).await, "");
    streams.remove(1);
    for stream in streams[1..].iter_mut().chain([&mut newcomer, &mut another]) {
        assert_eq!(livez(stream).await, 200, "the others are as they were");
    }
    // So is the one that was busy.
    streams[0].shutdown().await.unwrap();
    assert_eq!(status(&read_to_end(&mut streams[0]).await), 400);
}

#[tokio::test]
async fn where_nobody_makes_room_a_newcomer_is_told_so() {
    let service = Service::start(&["--max-connections", "16"]).await;
    let mut streams = Vec::new();
    for n in 0..16 {
        let from = if n < 12 { "127.0.0.1" } else { "127.0.0.2" };
        let mut stream = connect_from(from, service.address).await;
        make_busy(&mut stream).await;
        streams.push(stream);
    }
    // Those who ask, whoever they are, and those who say nothing, more of them than are waited for.
    let told = async |mut stream: TcpStream, text: &str| {
        let _ = stream.write_all(text.as_bytes()).await;
        read_to_end(&mut stream).await
    };
    for from in ["127.0.0.1", "127.0.0.3"] {
        let answer =
            told(connect_from(from, service.address).await, "GET /livez HTTP/1.1\r\nhost: localhost\r\n\r\n").await;
        assert_eq!(status(&answer), 503, "{answer}");
        assert!(answer.contains("retry-after: 1\r\n") && answer.contains("/problems/busy"), "{answer}");
        let (head, body) = answer.split_once("\r\n\r\n").unwrap();
        assert!(
            head.contains(&format!("content-length: {}", body.len())) && head.contains("connection: close"),
            "{head}"
        );
    }
    let silent = join_all((0..40).map(|_| TcpStream::connect(service.address))).await;
    for answer in join_all(silent.into_iter().map(|stream| told(stream.unwrap(), ""))).await {
        assert_eq!(status(&answer), 503, "{answer}");
    }
    // An address that has few places gets one as soon as there is one, and is seen by operators.
    drop(streams.pop());
    let request = "GET /metrics HTTP/1.1\r\nhost: localhost\r\nconnection: close\r\n\r\n";
    let measured = async || {
        let answer = told(connect_from("127.0.0.2", service.address).await, request).await;
        (status(&answer) == 200).then_some(answer)
    };
    let metrics = until("a place", measured).await;
    for name in ["\netude_connections ", "\netude_connections_refused_total "] {
        assert!(metrics.contains(name), "{metrics}");
    }
}

#[tokio::test]
async fn streams_leave_places_for_requests() {
    let service = Service::start(&["--max-connections", "16"]).await;
    let upgrade = "GET /v1/stream HTTP/1.1\r\nhost: localhost\r\nconnection: upgrade\r\nupgrade: websocket\r\n\
                   sec-websocket-version: 13\r\nsec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n";
    let mut streams = Vec::new();
    // Of one address each, as an address leaves as many to others as it has.
    for n in 3..15 {
        let mut stream = connect_from(&format!("127.0.0.{n}"), service.address).await;
        stream.write_all(upgrade.as_bytes()).await.unwrap();
        assert_eq!(status(&read_until(&mut stream, "\r\n\r\n").await), 101);
        streams.push(stream);
    }
    let mut other = connect_from("127.0.0.2", service.address).await;
    assert_eq!(livez(&mut other).await, 200);
    other.write_all(upgrade.as_bytes()).await.unwrap();
    assert_eq!(status(&read_until(&mut other, "}").await), 503);
    // Its place is given back, and taken along by the next.
    drop(streams.pop());
    let upgraded = async || {
        other.write_all(upgrade.as_bytes()).await.unwrap();
        if read_until(&mut other, "\r\n\r\n").await.contains(" 101 ") {
            return Some(());
        }
        read_until(&mut other, "}").await;
        None
    };
    until("the place of a stream", upgraded).await;
}

#[tokio::test]
async fn a_service_with_few_files_serves_on_refuses_and_says_so() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let mut process = Process::start_within("-n 64", &["--listen", "127.0.0.1:0"], &database);
    process.has_logged(&["fewer connections", "wanted=10000", "max_connections=16"]).await;
    let address: SocketAddr = process.address.parse().unwrap();
    // Many that say nothing, one after the other and at once.
    let silent = join_all((0..200).map(|_| TcpStream::connect(address))).await;
    assert_eq!(ask(address, "GET /readyz", &["host: localhost"]).await.0, 200);
    drop(silent);
    let mut busy = Vec::new();
    for n in 0..16 {
        let mut stream = connect_from(if n < 12 { "127.0.0.1" } else { "127.0.0.2" }, address).await;
        make_busy(&mut stream).await;
        busy.push(stream);
    }
    for _ in 0..3 {
        let (status, answer) = ask(address, "GET /livez", &["host: localhost"]).await;
        assert_eq!(status, 503, "{answer}");
    }
    process.has_logged(&["connections are refused", "n_refused=1", "n_taken=16"]).await;
    let silent = join_all((0..200).map(|_| TcpStream::connect(address))).await;
    process.has_logged(&["connections are refused"]).await;
    drop((silent, busy));
    let learner = reqwest::Client::builder().no_proxy().build().unwrap();
    let put = async || {
        let request = learner.put(format!("http://{address}/v1/learners/gold")).json(&json!({"attributes": ["x"]}));
        request.send().await.is_ok_and(|answer| answer.status() == 201).then_some(())
    };
    until("places of those who went away", put).await;
    process.kill();
}

#[tokio::test]
async fn the_limit_of_files_is_raised_as_far_as_it_goes() {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let mut process = Process::start_within("-Sn 64 && ulimit -Hn 1064", &["--listen", "127.0.0.1:0"], &database);
    process.has_logged(&["the limit of open files is raised", "from=64", "to=1064"]).await;
    process.has_logged(&["fewer connections", "max_connections=1000"]).await;
    process.kill();
}

#[tokio::test]
async fn a_peer_that_is_gone_without_a_word_is_noticed() {
    let service = Service::start(&[]).await;
    let mut stream = TcpStream::connect(service.address).await.unwrap();
    assert_eq!(livez(&mut stream).await, 200);
    // Of the service's end: addresses in hexadecimal, the state, the queues, and the timer, of which 2 is that of keepalive.
    let (local, remote) = (service.address.port(), stream.local_addr().unwrap().port());
    let sockets = std::fs::read_to_string("/proc/net/tcp").unwrap();
    let own = sockets.lines().find_map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let is_own = fields[1].ends_with(&format!(":{local:04X}")) && fields[2].ends_with(&format!(":{remote:04X}"));
        is_own.then(|| fields[5].to_owned())
    });
    assert!(own.as_deref().is_some_and(|timer| timer.starts_with("02:")), "{own:?}");
}
