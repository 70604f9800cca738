//! Clients that do not read what they asked for, and those beside them.

use futures_util::SinkExt;
use serde_json::{Value, json};
use tokio::net::{TcpSocket, TcpStream};
use tokio_tungstenite::tungstenite::Message;

use super::NDJSON;
use super::client::Client;
use crate::harness::process::Process;
use crate::harness::service::{Service, example};
use crate::harness::waiting::{until, within};

/// A connection that soon has no room for what is not read.
pub(super) async fn narrow(service: &Service) -> TcpStream {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(16 * 1024).unwrap();
    socket.connect(service.address).await.unwrap()
}

/// Sends frames that have answers by the thousand, and reads none, until the service closes the connection.
async fn send_and_never_read(client: &mut Client) {
    let demonstration = example("figure-4/demonstration.json");
    let states: Vec<&Value> = demonstration.as_array().unwrap().iter().cycle().take(800).collect();
    let mut seq = 0;
    loop {
        let frame = json!({"type": "observe", "seq": seq, "states": states});
        if client.socket.send(Message::text(frame.to_string())).await.is_err() {
            return;
        }
        seq += states.len();
    }
}

#[tokio::test]
async fn a_client_that_never_reads_is_closed_and_its_session_is_free_again() {
    let service = Service::start(&["--slow-reader-timeout", "200ms"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let mut stuck = Client::connect_narrowly(&service).await;
    let session = stuck.open(json!({"type": "open", "model": "figure-4", "lookahead": 1})).await;
    within("the end of a connection", send_and_never_read(&mut stuck)).await;
    let mut reader = Client::connect(&service).await;
    reader.send(json!({"type": "resume", "session": session})).await;
    let opened = reader.receive().await;
    assert!(opened["received"].as_u64().unwrap() >= 800, "{opened}");
    drop(stuck);
}

/// Whether both ends of a connection on this machine have something to send for which the other has no room: whether neither is read.
fn are_both_stuck(one_port: u16, other_port: u16) -> bool {
    let sockets = std::fs::read_to_string("/proc/net/tcp").unwrap();
    // Addresses in hexadecimal, the state, the queues, and the timer, of which 4 is that of probes of a window without room.
    let is_stuck = |from: u16, to: u16| {
        sockets.lines().map(|line| line.split_whitespace().collect::<Vec<_>>()).any(|fields| {
            fields[1].ends_with(&format!(":{from:04X}"))
                && fields[2].ends_with(&format!(":{to:04X}"))
                && fields[5].starts_with("04:")
        })
    };
    is_stuck(one_port, other_port) && is_stuck(other_port, one_port)
}

#[tokio::test]
async fn a_client_that_never_reads_holds_up_nobody() {
    let service = Service::start(&["--slow-reader-timeout", "1h", "--drain-timeout", "0s"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let demonstration = example("figure-4/demonstration.json");
    let mut stuck = Client::connect_narrowly(&service).await;
    let port = stuck.socket.get_ref().local_addr().unwrap().port();
    stuck.open(json!({"type": "open", "model": "figure-4", "lookahead": 1})).await;
    let sending = send_and_never_read(&mut stuck);
    let are_stuck = async || are_both_stuck(service.address.port(), port).then_some(());
    tokio::select! {
        () = sending => panic!("it is waited for"),
        () = until("a service and a client that wait for each other", are_stuck) => {}
    }
    for _ in 0..3 {
        let mut other = Client::connect(&service).await;
        other.open(json!({"type": "open", "model": "figure-4"})).await;
        other.send(json!({"type": "observe", "seq": 0, "states": demonstration})).await;
        other.send(json!({"type": "end", "seq": 16})).await;
        other.receive_until("done").await;
    }
    drop(stuck);
}

/// Every ping has an answer, which nobody reads.
#[tokio::test]
async fn a_client_that_sends_pings_and_never_reads_is_closed() {
    use tokio::io::AsyncWriteExt;
    let service = Service::start(&["--slow-reader-timeout", "200ms"]).await;
    let mut client = Client::connect_narrowly(&service).await;
    let ping = [&[0x89, 0xfd, 0, 0, 0, 0][..], &[b'x'; 125]].concat().repeat(100);
    let sending = async {
        let stream = client.socket.get_mut();
        while stream.write_all(&ping).await.is_ok() {}
    };
    within("the end of a connection", sending).await;
}

/// A hundred thousand observations and more, without a look at the answer, on a connection of its own.
#[tokio::test]
async fn who_sends_all_lines_before_reading_any_finds_the_connection_closed() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let service = Service::start(&["--slow-reader-timeout", "200ms", "--max-streams", "1"]).await;
    service.put("/v1/models/figure-4", &example("figure-4/model.json")).await;
    let demonstration = example("figure-4/demonstration.json").as_array().unwrap().clone();
    let mut client = narrow(&service).await;
    let (mut answer, mut request) = client.split();
    let head = format!(
        "POST /v1/stream HTTP/1.1\r\nhost: {}\r\ncontent-type: {NDJSON}\r\ntransfer-encoding: chunked\r\n\r\n",
        service.address
    );
    request.write_all(head.as_bytes()).await.unwrap();
    let mut send = async |frame: Value| {
        let line = frame.to_string() + "\n";
        request.write_all(format!("{:x}\r\n{line}\r\n", line.len()).as_bytes()).await
    };
    send(json!({"type": "open", "model": "figure-4", "lookahead": 1})).await.unwrap();
    let states: Vec<&Value> = demonstration.iter().cycle().take(100).collect();
    let sending = async {
        let mut seq = 0;
        while send(json!({"type": "observe", "seq": seq, "states": states})).await.is_ok() {
            seq += states.len();
        }
    };
    within("the end of a connection", sending).await;
    let mut all = Vec::new();
    // What has come is there; then nothing more comes.
    let _ = within("the end of the answer", answer.read_to_end(&mut all)).await;
    assert!(String::from_utf8_lossy(&all).contains("\"received\""));
    // Its place is free.
    Client::connect(&service).await.open(json!({"type": "open", "model": "figure-4"})).await;
}

/// The goodbye waits behind what the client left unread, and comes once that is read.
#[tokio::test]
async fn a_client_that_reads_too_late_is_told_that_it_was_too_slow() {
    let directory = tempfile::tempdir().unwrap();
    let flags = ["--listen", "127.0.0.1:0", "--slow-reader-timeout", "200ms"];
    let mut process = Process::start_with(&flags, &directory.path().join("etude.db"));
    let http = reqwest::Client::builder().no_proxy().build().unwrap();
    let model = http.put(format!("http://{}/v1/models/figure-4", process.address));
    let registered = model.json(&example("figure-4/model.json")).send().await.unwrap();
    assert!(registered.status().is_success());
    let mut client = Client::connect_to(&process.address).await;
    let session = client.open(json!({"type": "open", "model": "figure-4", "lookahead": 1})).await;

    let demonstration = example("figure-4/demonstration.json");
    let states: Vec<&Value> = demonstration.as_array().unwrap().iter().cycle().take(800).collect();
    let address = process.address.clone();
    let parts = ["stream closed", "1013", &session];
    let mut closing = Box::pin(process.has_logged(&parts));
    let mut seq = 0;
    loop {
        let frame = json!({"type": "observe", "seq": seq, "states": states});
        tokio::select! {
            () = &mut closing => break,
            // Once the service waits for this client, it takes nothing more from it.
            sent = client.socket.send(Message::text(frame.to_string())) => sent.unwrap(),
        }
        seq += states.len();
    }
    // Steps as they were committed, none missing, and then the reason.
    let (mut n_received, mut n_steps) = (0, 0);
    let code = loop {
        match client.next().await {
            Message::Text(text) => {
                let frame: Value = serde_json::from_str(&text).unwrap();
                match frame["type"].as_str().unwrap() {
                    "received" => n_received = frame["seq"].as_u64().unwrap(),
                    "step" => {
                        assert_eq!(frame["step"], n_steps);
                        n_steps += 1;
                    }
                    _ => panic!("{frame}"),
                }
            }
            Message::Close(close) => break u16::from(close.unwrap().code),
            _ => {}
        }
    };
    assert_eq!(code, 1013);
    assert!(n_received >= 800 && n_steps > 0, "{n_received} received, {n_steps} steps");

    let mut client = Client::connect_to(&address).await;
    client.send(json!({"type": "resume", "session": session, "step": n_steps})).await;
    let opened = client.receive().await;
    assert!(opened["received"].as_u64().unwrap() >= n_received, "{opened}");
    assert_eq!(client.receive().await["step"], n_steps);
    drop(closing);
    process.kill();
}
