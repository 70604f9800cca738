//! Streams over transports without a network.
//!
//! This file is longer than 400 lines because it is a list of facts, each of which stands by itself, with few helpers.

use std::time::Duration;

use clap::Parser;
use futures_util::{StreamExt, stream};
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::Role;
use tokio_util::sync::CancellationToken;
use tokio_util::task::TaskTracker;

use super::*;
use crate::client::Client;
use crate::clock::{Clock, Ids, timer_now};
use crate::config::ServeConfig;
use crate::service::{Etude, ModelText, Name};
use crate::stream::{Limits, Rooms};
use etude_core::model::Format;

/// Longer than anything here takes; a test that waits for this fails.
const TIMEOUT: Duration = Duration::from_secs(30);

#[derive(Parser)]
struct Flags {
    #[command(flatten)]
    config: ServeConfig,
}

/// The application, without a service, and the limits of its streams.
async fn application(flags: &[&str]) -> (Etude, Limits, TempDir) {
    let directory = tempfile::tempdir().unwrap();
    let database = directory.path().join("etude.db");
    let own = ["etude", "--database", database.to_str().unwrap()];
    let config = Flags::parse_from(own.iter().chain(flags)).config;
    let etude =
        Etude::open(&config.settings(Clock::system(), Ids::random()), &TaskTracker::new(), CancellationToken::new())
            .await
            .unwrap();
    (etude, config.stream_limits(), directory)
}

/// Speaks with a server over a websocket whose two ends hold so many bytes in between. The server is there for as long as `client` is, or
/// less.
async fn speak<T>(
    (etude, limits): (&Etude, Limits),
    max_bytes: usize,
    client: impl AsyncFnOnce(DuplexStream) -> T,
) -> T {
    let (ours, theirs) = tokio::io::duplex(max_bytes);
    let room = Rooms::new(etude.memory(), limits).admit(Client::LOCAL).unwrap();
    let stopping = CancellationToken::new();
    let serving = Box::pin(websocket::serve(etude, Client::LOCAL, limits, theirs, &room, &stopping));
    tokio::join!(serving, client(ours)).1
}

async fn client_end(io: DuplexStream) -> WebSocketStream<DuplexStream> {
    WebSocketStream::from_raw_socket(io, Role::Client, None).await
}

/// A frame of a client, masked with zeros.
fn frame(first_byte: u8, payload: &[u8]) -> Vec<u8> {
    let n_bytes = u8::try_from(payload.len()).unwrap();
    let length = if n_bytes < 126 { vec![0x80 | n_bytes] } else { vec![0xfe, 0, n_bytes] };
    [&[first_byte], &length[..], &[0; 4], payload].concat()
}

#[tokio::test]
async fn pongs_that_are_not_read_do_not_pile_up() {
    const N_PINGS: usize = 4000;
    let (etude, limits, _directory) = application(&[]).await;
    tokio::time::pause();
    let n_read = speak((&etude, limits), 1024, async |mut io| {
        let ping = frame(0x89, &[b'x'; 125]);
        for _ in 0..N_PINGS {
            io.write_all(&ping).await.unwrap();
        }
        // Something that has an answer, which finds room although pongs fill what there is.
        io.write_all(&frame(0x81, b"{")).await.unwrap();
        let mut all = Vec::new();
        io.read_to_end(&mut all).await.unwrap();
        assert!(String::from_utf8_lossy(&all).contains("malformed-json"));
        all.len()
    });
    let n_read = tokio::time::timeout(TIMEOUT, n_read).await.unwrap();
    let most = websocket::MAX_WRITE_BUFFER_BYTES + 4096;
    assert!(n_read <= most, "{n_read} of the {} bytes of all pongs were kept", 127 * N_PINGS);
    etude.close().await;
}

/// A frame of any size.
fn long_frame(first_byte: u8, payload: &[u8]) -> Vec<u8> {
    [&[first_byte, 0xff], &(payload.len() as u64).to_be_bytes()[..], &[0; 4], payload].concat()
}

/// A frame of so many bytes that ends a session, of which there is none.
fn long_end(n_bytes: usize) -> Vec<u8> {
    let end = json!({"type": "end", "seq": 0}).to_string();
    let padding = " ".repeat(n_bytes - end.len());
    (end + &padding).into_bytes()
}

#[tokio::test]
async fn a_large_frame_takes_its_memory_before_it_comes_and_leaves_nothing_of_it_behind() {
    let (etude, limits, _directory) = application(&[]).await;
    let before = etude.memory().free();
    let taken = || before - etude.memory().free();
    let spoken = speak((&etude, limits), 1 << 20, async |mut io| {
        let frame = long_frame(0x81, &long_end(200_000));
        let (some, rest) = frame.split_at(50_000);
        io.write_all(some).await.unwrap();
        // Until it has been read.
        let mut hello = [0; 20];
        io.read_exact(&mut hello).await.unwrap();
        while taken() < 400_000 {
            tokio::task::yield_now().await;
        }
        assert!(taken() < 500_000, "{}", taken());
        io.write_all(rest).await.unwrap();
        let mut all = Vec::new();
        io.read_to_end(&mut all).await.unwrap();
        assert!(String::from_utf8_lossy(&all).contains("not-allowed"), "{}", String::from_utf8_lossy(&all));
    });
    tokio::time::timeout(TIMEOUT, spoken).await.unwrap();
    assert_eq!(taken(), 0);
    etude.close().await;
}

#[tokio::test]
async fn a_frame_that_waits_for_the_one_before_it_takes_no_memory_to_be_handled() {
    let memory = crate::memory::Memory::with_room(256 << 20);
    let limits = Flags::parse_from(["etude"]).config.stream_limits();
    let room = Rooms::new(&memory, limits).admit(Client::LOCAL).unwrap();
    let (came, mut incoming) = crate::stream::queue(crate::stream::QUEUE_BYTES);
    let inlet = Inlet { came, room: &room };
    let large = || Bytes::from(vec![b' '; 100_000]);
    assert!(inlet.pass_on(large()).await.is_continue());
    let (free, first) = (memory.free(), incoming.recv().await.unwrap());
    let mut second = Box::pin(inlet.pass_on(large()));
    assert!(futures_util::poll!(&mut second).is_pending());
    assert_eq!(memory.free(), free);
    drop(first);
    assert!(second.await.is_continue());
    assert_eq!(memory.free(), free);
}

#[tokio::test]
async fn a_websocket_hears_of_large_frames_in_pieces_and_of_all_else_as_it_came() {
    let (etude, limits, _directory) = application(&[]).await;
    let rooms = Rooms::new(etude.memory(), limits);
    let large: Vec<u8> = (0..100_001_u32).map(|n| b'a' + u8::try_from(n % 23).unwrap()).collect();
    let masked = |first_byte, payload: &[u8]| {
        let mask = [1, 2, 3, 4];
        let bytes = payload.iter().enumerate().map(|(n, byte)| byte ^ mask[n % 4]);
        let head = [&[first_byte, 0xff], &(payload.len() as u64).to_be_bytes()[..], &mask].concat();
        [head, bytes.collect()].concat()
    };
    let sent = [
        frame(0x81, b"small"),
        masked(0x81, &large),
        frame(0x89, b"ping"),
        masked(0x01, &large[..50_000]),
        frame(0x8a, b"pong"),
        masked(0x80, &large[50_000..]),
        frame(0x81, b""),
    ];
    for n_at_a_time in [1, 13, 1 << 20] {
        let room = rooms.admit(Client::LOCAL).unwrap();
        let (mut ours, theirs) = tokio::io::duplex(n_at_a_time);
        let mut server =
            WebSocketStream::from_raw_socket(metered::Metered::new(theirs, &room, 262_144), Role::Server, None).await;
        let reading = async {
            let mut came = Vec::new();
            while let Some(Ok(message)) = server.next().await {
                came.push(message);
            }
            came
        };
        let sent = sent.concat();
        let sending = async {
            let (mut answers, mut ours) = tokio::io::split(&mut ours);
            ours.write_all(&sent).await.unwrap();
            ours.shutdown().await.unwrap();
            let mut all = Vec::new();
            answers.read_to_end(&mut all).await.unwrap();
        };
        let sending = async { tokio::time::timeout(TIMEOUT, sending).await };
        let came = tokio::select! { came = reading => came, _ = sending => panic!("it reads to the end") };
        let text = str::from_utf8(&large).unwrap();
        let ping = |text: &'static str| Message::Ping(text.into());
        let expected = [
            Message::text("small"),
            Message::text(text),
            ping("ping"),
            Message::Pong("pong".into()),
            Message::text(text),
            Message::text(""),
        ];
        assert!(came == expected, "{n_at_a_time} bytes at a time: {} messages", came.len());
    }
    etude.close().await;
}

/// How long it takes until `then` is answered, which ends the stream, after so many messages that say nothing.
async fn time_to_answer(quiet: &[u8], n_times: usize, then: &[u8]) -> Duration {
    let (etude, limits, _directory) = application(&[]).await;
    tokio::time::pause();
    let started = timer_now();
    let took = speak((&etude, limits), 1 << 20, async |mut io| {
        io.write_all(&[&quiet.repeat(n_times), then].concat()).await.unwrap();
        let mut all = Vec::new();
        while !String::from_utf8_lossy(&all).contains("malformed-json") {
            io.read_buf(&mut all).await.unwrap();
        }
        started.elapsed()
    })
    .await;
    tokio::time::resume();
    etude.close().await;
    took
}

#[tokio::test]
async fn pings_and_parts_that_say_nothing_are_read_slowly_where_there_are_many() {
    let malformed = frame(0x81, b"{");
    let [few, many] = [16, 1600].map(|n| (n, frame(0x89, b"there?")));
    assert_eq!(time_to_answer(&few.1, few.0 - 1, &malformed).await, Duration::ZERO);
    assert!(time_to_answer(&many.1, many.0, &malformed).await >= Duration::from_secs(1));
    assert!(time_to_answer(&frame(0x8a, b""), 1600, &malformed).await >= Duration::from_secs(1));
    // Parts of a message.
    let parts = [frame(0x01, b"{"), frame(0x00, b"").repeat(1600), frame(0x80, b"")].concat();
    assert!(time_to_answer(&parts, 1, &[]).await >= Duration::from_secs(1));
    // Between frames they are none too many.
    let between = [frame(0x89, b"").repeat(15), frame(0x81, b"{")].concat();
    assert_eq!(time_to_answer(&between, 1, &[]).await, Duration::ZERO);
}

#[tokio::test]
async fn a_client_that_gives_no_sign_of_life_is_asked_for_one_and_let_go() {
    let (etude, limits, _directory) = application(&[]).await;
    tokio::time::pause();
    let started = timer_now();
    speak((&etude, limits), 4096, async |mut io| {
        let mut all = Vec::new();
        io.read_to_end(&mut all).await.unwrap();
        let silent = started.elapsed();
        assert!((3 * limits.ping_every..=5 * limits.ping_every).contains(&silent), "{silent:?}");
        // Two pings of no bytes, and a close frame.
        assert!(all.windows(4).any(|bytes| bytes == [0x89, 0, 0x89, 0]), "{}", String::from_utf8_lossy(&all));
        let close: Vec<u8> = [&[0x88, 25][..], &1008_u16.to_be_bytes(), b"no sign of life; resume"].concat();
        assert!(all.ends_with(&close), "{}", String::from_utf8_lossy(&all));
    })
    .await;
    etude.close().await;
}

#[tokio::test]
async fn a_client_that_answers_pings_stays_for_as_long_as_it_likes() {
    let (etude, limits, _directory) = application(&[]).await;
    tokio::time::pause();
    speak((&etude, limits), 4096, async |io| {
        let mut client = client_end(io).await;
        let mut n_pings = 0;
        let reading = async {
            while let Some(Ok(message)) = client.next().await {
                n_pings += u32::from(message.is_ping());
            }
        };
        // Less than after which a session is idle.
        let ended = tokio::time::timeout(limits.ping_every * 100, reading).await;
        assert!(ended.is_err(), "it was let go after {n_pings} pings");
        assert!(n_pings > 40, "{n_pings}");
    })
    .await;
    etude.close().await;
}

#[tokio::test]
async fn what_websockets_do_not_allow_closes_them_with_1002_and_text_that_is_none_with_1007() {
    let (etude, limits, _directory) = application(&[]).await;
    let text_begins = frame(0x01, b"{");
    let cases = [
        ("a reserved data opcode", frame(0x83, b"x"), 1002),
        ("a reserved control opcode", frame(0x8b, b"x"), 1002),
        ("an unmasked frame", vec![0x81, 2, b'{', b'}'], 1002),
        ("a reserved bit", frame(0xc1, b"{}"), 1002),
        ("a continuation of nothing", frame(0x80, b"{}"), 1002),
        ("a message within another", [text_begins.clone(), frame(0x81, b"{}")].concat(), 1002),
        ("a fragmented ping", frame(0x09, b"x"), 1002),
        ("a ping that is too long", frame(0x89, &[b'x'; 126]), 1002),
        ("a close frame of one byte", frame(0x88, b"x"), 1002),
        ("text that is not UTF-8", frame(0x81, b"\xff\xfe"), 1007),
        ("text that is not UTF-8 as a whole", [text_begins, frame(0x80, b"\xff")].concat(), 1007),
    ];
    for (what, bytes, expected) in cases {
        let told = speak((&etude, limits), 4096, async |io| {
            let mut client = client_end(io).await;
            client.get_mut().write_all(&bytes).await.unwrap();
            let mut told = Vec::new();
            loop {
                match client.next().await {
                    Some(Ok(Message::Text(text))) => told.push(serde_json::from_str::<Value>(&text).unwrap()),
                    Some(Ok(Message::Close(close))) => return (told, u16::from(close.unwrap().code)),
                    other => panic!("{what}: {other:?}"),
                }
            }
        });
        let (frames, code) = tokio::time::timeout(TIMEOUT, told).await.unwrap();
        assert_eq!(code, expected, "{what}: {frames:?}");
        let kind = if code == 1002 { "/problems/bad-frame" } else { "/problems/malformed-json" };
        assert_eq!(frames.last().unwrap()["problem"]["type"], kind, "{what}");
    }
    // Who closes in good order with a code that must not be used is told so, and nothing else.
    let code = speak((&etude, limits), 4096, async |io| {
        let mut client = client_end(io).await;
        client.get_mut().write_all(&frame(0x88, &1005_u16.to_be_bytes())).await.unwrap();
        loop {
            match client.next().await {
                Some(Ok(Message::Close(close))) => return u16::from(close.unwrap().code),
                Some(Ok(Message::Text(text))) => assert!(text.contains("hello"), "{text}"),
                other => panic!("{other:?}"),
            }
        }
    });
    assert_eq!(tokio::time::timeout(TIMEOUT, code).await.unwrap(), 1002);
    etude.close().await;
}

#[tokio::test]
async fn a_client_that_vanishes_is_not_told_of_a_violation() {
    let (etude, limits, _directory) = application(&[]).await;
    let vanished = speak((&etude, limits), 4096, async |mut io| {
        io.shutdown().await.unwrap();
        let mut all = Vec::new();
        io.read_to_end(&mut all).await.unwrap();
        assert!(!String::from_utf8_lossy(&all).contains("error"), "{}", String::from_utf8_lossy(&all));
    });
    tokio::time::timeout(TIMEOUT, vanished).await.unwrap();
    etude.close().await;
}

/// As long as the client sends, and reads nothing.
#[tokio::test]
async fn who_sends_lines_without_end_and_reads_none_is_let_go_and_gives_its_memory_back() {
    let (etude, limits, _directory) = application(&["--slow-reader-timeout", "100ms"]).await;
    let model = json!({
        "attributes": [{"name": "x", "kind": "number"}], "actions": [{"name": "on", "cost": 1}],
        "dynamics": {"kind": "table", "states": [[0], [1]], "transitions": [[0, "on", 1], [1, "on", 0]], "start": 0},
    });
    let (text, format) = (ModelText::Whole(model.to_string().into_bytes()), Format::Json);
    let caller = Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: Clock::system().now() };
    etude.put_model(&Name::new("m").unwrap(), text, format, caller).await.unwrap();
    let free = etude.memory().free();
    let room = Rooms::new(etude.memory(), limits).admit(Client::LOCAL).unwrap();
    let open = json!({"type": "open", "model": "m", "lookahead": 1}).to_string();
    let observe = |seq: u32| json!({"type": "observe", "seq": seq, "states": [{"x": seq % 2}]}).to_string();
    let lines = std::iter::once(open).chain((0..).map(observe)).map(|line| Ok::<_, axum::Error>(line + "\n"));
    let body = ndjson::begin_reading(Request::new(Body::from_stream(stream::iter(lines)))).await;
    let (lines, mut answer) = mpsc::channel(1);
    let stopping = CancellationToken::new();
    let serving = Box::pin(ndjson::serve(&etude, Client::LOCAL, limits, body, lines, &room, &stopping));
    tokio::time::timeout(TIMEOUT, serving).await.unwrap();
    drop(room);
    assert_eq!(etude.memory().free(), free);
    assert!(answer.recv().await.is_some_and(|line| line.unwrap().starts_with(b"{\"type\":\"hello\"")));
    assert!(answer.recv().await.is_none(), "the answer has ended");
    etude.close().await;
}

#[tokio::test(start_paused = true)]
async fn blank_lines_are_read_slowly_where_there_are_many() {
    let memory = crate::memory::Memory::with_room(8 << 20);
    let limits = Flags::parse_from(["etude"]).config.stream_limits();
    let room = Rooms::new(&memory, limits).admit(Client::LOCAL).unwrap();
    for (n_blank, expected) in [(15, Duration::ZERO), (1600, Duration::from_secs(1))] {
        let (came, mut incoming) = crate::stream::queue(crate::stream::QUEUE_BYTES);
        let lines = Body::from("\n".repeat(n_blank) + "{}\n");
        let body = ndjson::begin_reading(Request::new(lines)).await;
        let started = timer_now();
        ndjson::read(body, limits.frame_bytes, Inlet { came, room: &room }).await;
        assert_eq!(started.elapsed(), expected);
        assert!(matches!(incoming.recv().await.unwrap().item, Incoming::Frame { .. }));
    }
}

#[tokio::test(start_paused = true)]
async fn a_line_without_an_end_takes_its_memory_before_it_is_complete_and_no_more_than_a_frame() {
    let memory = crate::memory::Memory::with_room(8 << 20);
    let limits = Flags::parse_from(["etude"]).config.stream_limits();
    let room = Rooms::new(&memory, limits).admit(Client::LOCAL).unwrap();
    let before = memory.free();
    let (came, mut incoming) = crate::stream::queue(crate::stream::QUEUE_BYTES);
    let (begins, body) = mpsc::channel::<Result<Vec<u8>, axum::Error>>(1);
    let body = ndjson::begin_reading(Request::new(Body::from_stream(ReceiverStream::new(body)))).await;
    let reading = ndjson::read(body, limits.frame_bytes, Inlet { came, room: &room });
    let sending = async {
        begins.send(Ok(vec![b'x'; 100_000])).await.unwrap();
        // Taken before more is read.
        begins.send(Ok(Vec::new())).await.unwrap();
        begins.reserve().await.unwrap();
        assert_eq!(before - memory.free(), (2 * 100_000_u64).next_multiple_of(4096));
        begins.send(Ok(vec![b'x'; 200_000])).await.unwrap();
        assert!(matches!(incoming.recv().await.unwrap().item, Incoming::TooLarge));
    };
    tokio::join!(reading, sending);
}

/// Frames that wait together, as what an observation commits does.
async fn waiting_frames(texts: &[String]) -> crate::stream::Receiver<crate::stream::Outgoing> {
    let (outgoing, goes) = crate::stream::queue(1 << 20);
    for text in texts {
        outgoing.send(crate::stream::Outgoing::Frame(text.clone())).await.unwrap();
    }
    goes
}

#[tokio::test]
async fn lines_that_wait_together_are_written_together_as_long_as_they_are_small() {
    let memory = crate::memory::Memory::with_room(8 << 20);
    let limits = Flags::parse_from(["etude"]).config.stream_limits();
    let room = Rooms::new(&memory, limits).admit(Client::LOCAL).unwrap();
    let small: Vec<String> = (0..5).map(|n| format!("{{\"step\":{n}}}")).collect();
    let large = "x".repeat(20_000);
    let texts = [&small[..], std::slice::from_ref(&large), &small].concat();
    let (lines, mut answer) = mpsc::channel(16);
    ndjson::write(&lines, waiting_frames(&texts).await, &room).await;
    drop(lines);
    let together = small.join("\n") + "\n";
    for expected in [&together, &(large + "\n"), &together] {
        let chunk = answer.recv().await.unwrap().unwrap();
        assert!(chunk == *expected, "{} bytes, not {}", chunk.len(), expected.len());
    }
    assert!(answer.recv().await.is_none());
}

/// A socket whose writes are counted.
struct Counted {
    socket: DuplexStream,
    n_writes: std::sync::Arc<std::sync::atomic::AtomicUsize>,
}

impl tokio::io::AsyncRead for Counted {
    fn poll_read(
        mut self: std::pin::Pin<&mut Self>,
        cx: &mut std::task::Context<'_>,
        to: &mut tokio::io::ReadBuf<'_>,
    ) -> std::task::Poll<std::io::Result<()>> {
        std::pin::Pin::new(&mut self.socket).poll_read(cx, to)
    }
}

impl tokio::io::AsyncWrite for Counted {
    fn poll_write(
        mut self: std::pin::Pin<&mut Self>,
        cx: &mut std::task::Context<'_>,
        bytes: &[u8],
    ) -> std::task::Poll<std::io::Result<usize>> {
        self.n_writes.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        std::pin::Pin::new(&mut self.socket).poll_write(cx, bytes)
    }

    fn poll_flush(
        mut self: std::pin::Pin<&mut Self>,
        cx: &mut std::task::Context<'_>,
    ) -> std::task::Poll<std::io::Result<()>> {
        std::pin::Pin::new(&mut self.socket).poll_flush(cx)
    }

    fn poll_shutdown(
        mut self: std::pin::Pin<&mut Self>,
        cx: &mut std::task::Context<'_>,
    ) -> std::task::Poll<std::io::Result<()>> {
        std::pin::Pin::new(&mut self.socket).poll_shutdown(cx)
    }
}

#[tokio::test]
async fn what_an_observation_is_answered_by_is_one_write_of_a_websocket() {
    let (etude, limits, _directory) = application(&[]).await;
    let model = include_str!("../../../examples/figure-4/model.json");
    let caller = Caller { client: Client::LOCAL, arrived: Clock::system().instant(), now: Clock::system().now() };
    let text = ModelText::Whole(model.as_bytes().to_vec());
    etude.put_model(&Name::new("m").unwrap(), text, Format::Json, caller).await.unwrap();
    let seen: Vec<Value> = serde_json::from_str(include_str!("../../../examples/figure-4/demonstration.json")).unwrap();
    let (ours, theirs) = tokio::io::duplex(1 << 20);
    let n_writes = std::sync::Arc::default();
    let socket = Counted { socket: theirs, n_writes: std::sync::Arc::clone(&n_writes) };
    let room = Rooms::new(etude.memory(), limits).admit(Client::LOCAL).unwrap();
    let stopping = CancellationToken::new();
    let serving = Box::pin(websocket::serve(&etude, Client::LOCAL, limits, socket, &room, &stopping));
    let speaking = async {
        let mut client = client_end(ours).await;
        let open = json!({"type": "open", "model": "m", "lookahead": 1});
        futures_util::SinkExt::send(&mut client, Message::text(open.to_string())).await.unwrap();
        let mut n_frames = 0;
        let mut next = async |client: &mut WebSocketStream<DuplexStream>| {
            n_frames += 1;
            let message = client.next().await.unwrap().unwrap();
            (n_frames, serde_json::from_str::<Value>(message.to_text().unwrap()).unwrap())
        };
        while next(&mut client).await.1["type"] != "opened" {}
        let before = n_writes.load(std::sync::atomic::Ordering::Relaxed);
        let mut n_all = 0;
        for (seq, state) in seen.iter().enumerate() {
            let observe = json!({"type": "observe", "seq": seq, "states": [state]});
            futures_util::SinkExt::send(&mut client, Message::text(observe.to_string())).await.unwrap();
            loop {
                let (n_frames, frame) = next(&mut client).await;
                n_all = n_frames - 2;
                // The lookahead of one is used up by each.
                if frame["type"] == "step" && frame["observation"] == seq && frame["move"] != "extra" {
                    break;
                }
            }
        }
        let n_written = n_writes.load(std::sync::atomic::Ordering::Relaxed) - before;
        assert_eq!(n_written, seen.len(), "{n_all} frames");
        assert!(n_all > 2 * seen.len() - 2, "{n_all}");
        futures_util::SinkExt::close(&mut client).await.unwrap();
    };
    tokio::time::timeout(TIMEOUT, async { tokio::join!(serving, speaking) }).await.unwrap();
    etude.close().await;
}
