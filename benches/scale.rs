//! Models of growing size through the real HTTP path: `cargo bench --bench scale [-- states ..] [shuffled]`, a hundred to ten million
//! states if left out, which takes some minutes and 2 GiB of memory. `shuffled`: every state has a number of its own, and transitions are
//! not in the order of states, which is the least that a model can do to be compact.
//!
//! A model of N states has ten transitions a state. It is generated, compressed and sent as a stream, and never held as text. The service
//! is a process of its own, fresh for each size, so that its peak of resident memory (`VmHWM`) is of that model alone. Client and service
//! share the machine: the time to generate and compress alone is given for comparison. A second process reads and compiles the same
//! model by itself, step by step, to tell where time and memory go.

#![expect(clippy::disallowed_methods, reason = "a benchmark measures by the system's clock")]
#![expect(clippy::print_stdout, reason = "this is where a benchmark's results go")]

use std::io::{self, BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use etude_core::interrupt::Uninterrupted;
use etude_core::mapping::Mapper;
use etude_core::model::{Definition, Format, Limits, Model};
use flate2::Compression;
use flate2::write::GzEncoder;
use reqwest::{Body, Client};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;

const SIZES: [u64; 6] = [100, 1_000, 10_000, 100_000, 1_000_000, 10_000_000];
/// Up to here also as JSON with gzip.
const MAX_GZIP: u64 = 100_000;
const N_ACTIONS: u64 = 10;
/// The argument by which this program runs itself to read and compile a model alone.
const ALONE: &str = "--alone";
const SHUFFLED: &str = "shuffled";

#[tokio::main]
async fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let order = if arguments.iter().any(|argument| argument == SHUFFLED) { Order::Shuffled } else { Order::Sorted };
    let mut sizes: Vec<u64> = arguments.iter().filter_map(|argument| argument.parse().ok()).collect();
    if arguments.iter().any(|argument| argument == ALONE) {
        for n in sizes {
            alone(n, order);
        }
        return;
    }
    if sizes.is_empty() {
        sizes = SIZES.to_vec();
    }
    let mut times = Vec::new();
    for n in sizes {
        println!("{n} states, {} transitions", n * N_ACTIONS);
        if n <= MAX_GZIP {
            report("  JSON, gzip", n, &upload(n, Layout::Json, order).await);
        }
        let sent = upload(n, Layout::Ndjson, order).await;
        report("  NDJSON, zstd", n, &sent);
        times.push((n, sent.elapsed));
        let mut alone = Command::new(std::env::current_exe().expect("this program"));
        alone.args([ALONE, &n.to_string()]).args((order == Order::Shuffled).then_some(SHUFFLED));
        assert!(alone.status().expect("this program").success());
        if let [.., before, last] = times.as_slice() {
            println!("  time grows as N^{:.2} from the size before", exponent(&[*before, *last]));
        }
    }
    if times.len() > 1 {
        println!("time of NDJSON uploads grows as N^{:.2} over all sizes", exponent(&times));
    }
    let large: Vec<_> = times.iter().copied().filter(|(n, _)| *n >= 10_000).collect();
    if large.len() > 1 {
        println!("time of NDJSON uploads grows as N^{:.2} from ten thousand states on", exponent(&large));
    }
}

/// The slope of a line through the logarithms, by least squares.
#[expect(clippy::cast_precision_loss, reason = "far below 2^52")]
fn exponent(times: &[(u64, Duration)]) -> f64 {
    let points: Vec<(f64, f64)> = times.iter().map(|(n, time)| ((*n as f64).ln(), time.as_secs_f64().ln())).collect();
    let n_points = points.len() as f64;
    let mean_x = points.iter().map(|(x, _)| x).sum::<f64>() / n_points;
    let mean_y = points.iter().map(|(_, y)| y).sum::<f64>() / n_points;
    let covariance: f64 = points.iter().map(|(x, y)| (x - mean_x) * (y - mean_y)).sum();
    covariance / points.iter().map(|(x, _)| (x - mean_x).powi(2)).sum::<f64>()
}

struct Sent {
    generating: Duration,
    elapsed: Duration,
    text_bytes: u64,
    wire_bytes: u64,
    database_bytes: u64,
    peak_bytes: u64,
    /// From a fresh start to the first policy, which must read and compile the stored model.
    anew: Duration,
    anew_peak_bytes: u64,
}

#[expect(clippy::cast_precision_loss, reason = "far below 2^52")]
fn report(name: &str, n: u64, sent: &Sent) {
    let things = (n * (1 + N_ACTIONS)) as f64;
    let mib = |bytes: u64| bytes as f64 / f64::from(1 << 20);
    println!(
        "{name}: {:.3} s ({:.0} ns per state or transition; generating alone {:.3} s), {:.1} MiB of text, {:.2} MiB sent, \
         {:.2} MiB of database, peak {:.0} MiB ({:.0} bytes per state or transition); from disk to the first policy {:.3} s, \
         peak {:.0} MiB",
        sent.elapsed.as_secs_f64(),
        sent.elapsed.as_secs_f64() * 1e9 / things,
        sent.generating.as_secs_f64(),
        mib(sent.text_bytes),
        mib(sent.wire_bytes),
        mib(sent.database_bytes),
        mib(sent.peak_bytes),
        sent.peak_bytes as f64 / things,
        sent.anew.as_secs_f64(),
        mib(sent.anew_peak_bytes),
    );
}

#[derive(Clone, Copy, PartialEq)]
enum Order {
    Sorted,
    Shuffled,
}

#[derive(Clone, Copy)]
enum Layout {
    Json,
    Ndjson,
}

/// Uploads a model to a fresh service.
async fn upload(n: u64, layout: Layout, order: Order) -> Sent {
    let started = Instant::now();
    let (text_bytes, wire_bytes) = {
        let mut sink = Counted { inner: io::sink(), n_bytes: 0 };
        let text_bytes = compress(n, layout, order, &mut sink);
        (text_bytes, sink.n_bytes)
    };
    let generating = started.elapsed();
    let directory = tempfile::tempdir().expect("a temporary directory");
    let database = directory.path().join("etude.db");
    let service = Service::start(&database);
    let client = Client::builder().no_proxy().build().expect("a client");

    let (sender, chunks) = mpsc::channel(4);
    std::thread::spawn(move || compress(n, layout, order, io::BufWriter::with_capacity(1 << 18, Chunks(sender))));
    let (content_type, encoding) = match layout {
        Layout::Json => ("application/json", "gzip"),
        Layout::Ndjson => ("application/x-ndjson", "zstd"),
    };
    let started = Instant::now();
    let request = client
        .put(format!("{}/v1/models/large", service.base))
        .header("content-type", content_type)
        .header("content-encoding", encoding)
        .body(Body::wrap_stream(ReceiverStream::new(chunks)));
    let response = request.send().await.expect("an answer");
    let elapsed = started.elapsed();
    let (status, answer) = (response.status(), response.text().await.expect("an answer"));
    assert_eq!(status.as_u16(), 201, "{answer}");
    let answer: Value = serde_json::from_str(&answer).expect("JSON");
    assert_eq!(answer["counts"]["transitions"], n * N_ACTIONS);
    let peak_bytes = service.peak_bytes();
    drop(service);

    let service = Service::start(&database);
    let files = std::fs::read_dir(directory.path()).expect("a directory");
    let database_bytes = files.map(|file| file.and_then(|file| file.metadata()).map_or(0, |file| file.len())).sum();
    let demonstration: Vec<Value> = (0..10).map(|x| json!({"x": x, "y": 0})).collect();
    let request = json!({"model": "large", "demonstration": demonstration, "start": 0, "deadline_ms": 3_600_000});
    let started = Instant::now();
    let response = client.post(format!("{}/v1/policies", service.base)).json(&request).send().await.expect("an answer");
    let status = response.status();
    assert_eq!(status.as_u16(), 201, "{}", response.text().await.unwrap_or_default());
    let (anew, anew_peak_bytes) = (started.elapsed(), service.peak_bytes());
    Sent { generating, elapsed, text_bytes, wire_bytes, database_bytes, peak_bytes, anew, anew_peak_bytes }
}

/// Reads and compiles a model in this process, and prints where time and memory go.
#[expect(clippy::cast_precision_loss, reason = "far below 2^52")]
fn alone(n: u64, order: Order) {
    let (reader, mut writer) = io::pipe().expect("a pipe");
    let generator = std::thread::spawn(move || {
        let mut writer = io::BufWriter::with_capacity(1 << 16, &mut writer);
        write_model(n, Layout::Ndjson, order, &mut writer);
    });
    let mut last = Instant::now();
    let mut step = |name: &str| {
        let elapsed = std::mem::replace(&mut last, Instant::now()).elapsed().as_secs_f64();
        let mib = memory("self", "VmHWM") as f64 / f64::from(1 << 20);
        println!(
            "    {name}: {elapsed:.3} s, {:.0} ns a state or transition, peak {mib:.0} MiB",
            elapsed * 1e9 / (n * (1 + N_ACTIONS)) as f64
        );
    };
    let reader = BufReader::with_capacity(1 << 16, reader);
    let definition = Definition::parse_from(reader, Format::Ndjson, Limits::NONE, &mut Uninterrupted).expect("a model");
    generator.join().expect("a model");
    step("read, not compressed, while it is generated");
    let model = Model::compile(&definition, Limits::NONE, &mut Uninterrupted).expect("a model");
    step("compile");
    let mut hash = Sha256::new();
    definition.write(io::BufWriter::with_capacity(1 << 16, &mut hash)).expect("a sink");
    step("write and hash the canonical text");
    drop(definition);
    let size = model.size_bytes() as f64;
    let graph = (n * N_ACTIONS * 8 + (n + 1) * 4) as f64;
    println!(
        "    compiled: {:.1} MiB; {:.1} bytes a state and {:.1} a transition",
        size / f64::from(1 << 20),
        (size - graph) / n as f64 + 4.0,
        8.0
    );
    let mapper = Mapper::new(model, &mut Uninterrupted).expect("not interrupted");
    step("prepare for mapping");
    println!("    ready to be searched: {:.1} MiB", mapper.size_bytes() as f64 / f64::from(1 << 20));
}

/// Writes the model, compressed. Gives the bytes of the text.
fn compress(n: u64, layout: Layout, order: Order, writer: impl Write) -> u64 {
    match layout {
        Layout::Json => {
            let mut text = Counted { inner: GzEncoder::new(writer, Compression::fast()), n_bytes: 0 };
            write_model(n, layout, order, &mut text);
            let mut writer = text.inner.finish().expect("a reader");
            writer.flush().expect("a reader");
            text.n_bytes
        }
        Layout::Ndjson => {
            let encoder = zstd::Encoder::new(writer, 1).expect("an encoder");
            let mut text = Counted { inner: encoder, n_bytes: 0 };
            write_model(n, layout, order, &mut text);
            let mut writer = text.inner.finish().expect("a reader");
            writer.flush().expect("a reader");
            text.n_bytes
        }
    }
}

/// A grid of cells with four headings, from each of which ten actions lead elsewhere: to neighbours, and far away.
fn write_model(n: u64, layout: Layout, order: Order, writer: &mut impl Write) {
    const NAMES: [&str; 10] =
        ["forward", "turn_left", "turn_right", "back", "sidestep", "jump", "climb", "leap", "slide", "teleport"];
    const LABELS: [&str; 4] = ["east", "north", "west", "south"];
    let n_columns = (n / 4).isqrt().max(1);
    let offsets = [4, 1, 3, n - 4, 8, 4 * n_columns, n - 4 * n_columns, 12, 2 * n_columns, n / 2 + 1];
    let actions: Vec<Value> = NAMES.iter().map(|name| json!({"name": name, "cost": 0.3})).collect();
    let mut attributes = json!([
        {"name": "x", "kind": "number"}, {"name": "y", "kind": "number"},
        {"name": "heading", "kind": "cyclic", "labels": LABELS},
    ]);
    if order == Order::Shuffled {
        attributes.as_array_mut().expect("an array").push(json!({"name": "id", "kind": "number", "weight": 0}));
    }
    let state = |state: u64| {
        let (x, y, heading) = (state / 4 % n_columns, state / 4 / n_columns, LABELS[(state % 4) as usize]);
        match order {
            Order::Sorted => format!("[{x},{y},\"{heading}\"]"),
            Order::Shuffled => format!("[{x},{y},\"{heading}\",{state}.5]"),
        }
    };
    let transition = |k: u64| {
        let (from, action) = match order {
            Order::Sorted => (k / N_ACTIONS, k % N_ACTIONS),
            // From here and there: the step has no factor in common with any number of states that is measured.
            Order::Shuffled => ((k % n) * 7_919 % n, k / n),
        };
        let action = usize::try_from(action).expect("one of ten");
        format!("[{from},\"{}\",{}]", NAMES[action], (from + offsets[action]) % n)
    };
    let result = match layout {
        Layout::Json => (|| {
            write!(
                writer,
                "{{\"attributes\":{attributes},\"actions\":{},\"dynamics\":{{\"kind\":\"table\",\"states\":[",
                json!(actions)
            )?;
            list(writer, 0..n, state)?;
            write!(writer, "],\"transitions\":[")?;
            list(writer, 0..n * N_ACTIONS, transition)?;
            write!(writer, "],\"start\":0}}}}")
        })(),
        Layout::Ndjson => (|| {
            let head = json!({"attributes": attributes, "actions": actions, "dynamics": {"kind": "table", "start": 0}});
            writeln!(writer, "{head}")?;
            lines(writer, "states", n, state)?;
            lines(writer, "transitions", n * N_ACTIONS, transition)
        })(),
    };
    let written: io::Result<()> = result;
    written.expect("a reader");
}

fn list(writer: &mut impl Write, mut numbers: std::ops::Range<u64>, item: impl Fn(u64) -> String) -> io::Result<()> {
    if let Some(first) = numbers.next() {
        write!(writer, "{}", item(first))?;
    }
    numbers.try_for_each(|number| write!(writer, ",{}", item(number)))
}

fn lines(writer: &mut impl Write, name: &str, count: u64, item: impl Fn(u64) -> String) -> io::Result<()> {
    const N_EACH: u64 = 1000;
    for first in (0..count).step_by(1000) {
        write!(writer, "{{\"{name}\":[")?;
        list(writer, first..count.min(first + N_EACH), &item)?;
        writeln!(writer, "]}}")?;
    }
    Ok(())
}

/// Counts what goes through.
struct Counted<W> {
    inner: W,
    n_bytes: u64,
}

impl<W: Write> Write for Counted<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let n_written = self.inner.write(bytes)?;
        self.n_bytes += n_written as u64;
        Ok(n_written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.inner.flush()
    }
}

/// Sends what is written on to the client's body.
struct Chunks(mpsc::Sender<io::Result<Vec<u8>>>);

impl Write for Chunks {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.blocking_send(Ok(bytes.to_vec())).map_err(|_| io::ErrorKind::BrokenPipe)?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// The real program. Killed when dropped: what it has answered is on disk.
struct Service {
    child: Child,
    base: String,
}

impl Service {
    fn start(database: &Path) -> Self {
        let limits =
            ["--max-states", "--max-transitions", "--max-model-bytes", "--max-model-text-bytes", "--model-cache-bytes"];
        let mut command = Command::new(env!("CARGO_BIN_EXE_etude"));
        command.args(["serve", "--listen", "127.0.0.1:0", "--log-format", "text"]).arg("--database").arg(database);
        command.args(limits.iter().flat_map(|limit| [limit, "8000000000"]));
        let mut child = command.stderr(Stdio::piped()).spawn().expect("the program");
        let mut log = BufReader::new(child.stderr.take().expect("a pipe")).lines();
        let base = log.find_map(|line| {
            let address = line.expect("a log").split("http://").nth(1)?.split(['"', ' ']).next()?.to_owned();
            Some(format!("http://{address}"))
        });
        std::thread::spawn(move || log.for_each(drop));
        Self { child, base: base.expect("it listens") }
    }

    fn peak_bytes(&self) -> u64 {
        memory(&self.child.id().to_string(), "VmHWM")
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        self.child.kill().expect("it runs");
        self.child.wait().expect("it ran");
    }
}

/// A figure of a process's memory, in bytes.
fn memory(process: &str, figure: &str) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).expect("a process");
    let line = status.lines().find_map(|line| line.strip_prefix(figure)?.strip_prefix(':')).expect("a figure");
    let kib: u64 = line.trim().trim_end_matches(" kB").parse().expect("a figure");
    kib << 10
}
