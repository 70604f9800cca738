//! Reading bodies.
//!
//! Nobody waits for a client for ever, and nobody takes a client's word for how much will come: each body has a limit in bytes and a
//! least speed, and takes memory as its bytes come. A refused request is answered at once; the rest of its body is read and discarded
//! meanwhile, for a limited time.

use std::io::{self, BufRead};
use std::time::Duration;

use axum::body::{BodyDataStream, Bytes, HttpBody};
use axum::extract::{FromRequestParts, Request};
use axum::http::HeaderMap;
use axum::http::header::{CONTENT_LENGTH, EXPECT, TRANSFER_ENCODING};
use axum::http::request::Parts;
use futures_util::StreamExt;

use super::Context;
use super::collected::Collected;
use super::encoding::{BodyError, DecodedLimit, Encoding};
use super::form::{essence, form_of, format_of};
use super::problem::{Problem, ProblemKind};
use crate::client::Client;
use crate::clock::timer_now;
use crate::memory::Held;
use crate::service::{ModelForm, ModelText, OpenText, PipeWriter, ServiceError, pipe};
use etude_core::document::Quoted;
use etude_core::model::{Format, ImportFormat};

/// How long a client may take to send its body, however slowly it comes.
const BODY_TIMEOUT: Duration = Duration::from_mins(1);

/// Least rate of a body once [`BODY_TIMEOUT`] has passed. A slower one keeps others from sending theirs.
const MIN_BYTES_PER_S: u64 = 64 * 1024;

/// How long the rest of a body that is not wanted is read and thrown away. Most clients only look at the answer once they have sent
/// everything; past this, they find the connection closed.
const DISCARD_TIMEOUT: Duration = Duration::from_secs(10);

/// Most bytes of an unwanted body that are read and thrown away, as a multiple of the limit.
const MAX_DISCARDED_LIMITS: usize = 64;

/// Bodies of models up to this size, in bytes, are buffered whole before they are read.
const AT_HAND_BYTES: usize = 1 << 20;

/// Largest body of a reward or of a reason.
const MAX_SMALL_BODY_BYTES: usize = 16 * 1024;

/// Reads the JSON body of a request, which has its limit as it is sent and once it is decompressed. The memory of a large one is held
/// as long as its bytes.
pub(super) async fn read_json(request: Request, context: &Context) -> Result<Bytes, Problem> {
    let limit = SentLimit { n_bytes: context.max_body_bytes, setting: "ETUDE_MAX_BODY_BYTES" };
    read_json_within(limit, request, context).await
}

/// Reads the JSON body of a request that has only little to say.
pub(super) async fn read_small_json(request: Request, context: &Context) -> Result<Bytes, Problem> {
    if context.max_body_bytes < MAX_SMALL_BODY_BYTES {
        return read_json(request, context).await;
    }
    let limit = SentLimit { n_bytes: MAX_SMALL_BODY_BYTES, setting: "for this path, whatever the settings" };
    read_json_within(limit, request, context).await
}

/// Reads the lines (NDJSON) of a request, likewise.
pub(super) async fn read_lines(request: Request, context: &Context) -> Result<Bytes, Problem> {
    let limit = SentLimit { n_bytes: context.max_body_bytes, setting: "ETUDE_MAX_BODY_BYTES" };
    read_within(limit, Format::Ndjson, request, context).await
}

async fn read_json_within(limit: SentLimit, request: Request, context: &Context) -> Result<Bytes, Problem> {
    read_within(limit, Format::Json, request, context).await
}

async fn read_within(limit: SentLimit, format: Format, request: Request, context: &Context) -> Result<Bytes, Problem> {
    let is_declared = format_of(request.headers()) == Some(format);
    let detail = "send JSON with the header `content-type: application/json`";
    let encoding = match declared_encoding(request.headers()) {
        Ok(encoding) if is_declared => encoding,
        Err(problem) if is_declared => return Err(refuse(request, context, problem)),
        _ => return Err(refuse(request, context, Problem::new(ProblemKind::UnsupportedMediaType, detail))),
    };
    let client = request.extensions().get::<Client>().copied().unwrap_or(Client::LOCAL);
    let (collected, _) = collect(open(request, limit, context)?, usize::MAX, context).await?;
    let bytes = collected.into_bytes();
    if encoding == Encoding::Identity {
        return Ok(bytes);
    }
    let memory = context.etude.memory().clone();
    // Off the threads that serve others; bounded by the limit.
    let decode = move || -> io::Result<Bytes> {
        let limit = DecodedLimit { n_bytes: limit.n_bytes as u64, setting: limit.setting };
        let mut decoder = encoding.decode(io::Cursor::new(bytes), limit)?;
        let mut decoded = Collected::new(&memory);
        loop {
            let chunk = decoder.fill_buf()?;
            if chunk.is_empty() {
                return Ok(decoded.into_bytes());
            }
            decoded.push(chunk).map_err(BodyError::NoRoom)?;
            let n_bytes = chunk.len();
            decoder.consume(n_bytes);
            // The decoder looks back at as much.
            let n_seen = decoded.n_bytes().min(Encoding::MAX_WINDOW_BYTES);
            decoded.reserve(decoded.capacity() + n_seen).map_err(BodyError::NoRoom)?;
        }
    };
    let decoded = context.etude.pool().read_in_turn(client, limit.n_bytes, decode).await;
    decoded.map_err(ServiceError::from)?.map_err(|error| Problem::unreadable(&error))
}

/// Most bytes of a body as it is sent, and what the setting is called.
#[derive(Clone, Copy, Debug)]
pub(super) struct SentLimit {
    pub(super) n_bytes: usize,
    pub(super) setting: &'static str,
}

/// The body of a model.
pub(super) struct SentModel {
    pub(super) text: ModelText,
    pub(super) form: ModelForm,
    /// What is still to come of it.
    pub(super) pump: Option<Pump>,
    /// The memory of what is at hand, if that is much.
    pub(super) held: Option<Held>,
}

/// Reads the body of a model: JSON or NDJSON, compressed or not. A large one is read as it comes.
pub(super) async fn read_model(
    request: Request,
    sent: SentLimit,
    decoded: DecodedLimit,
    context: &Context,
) -> Result<SentModel, Problem> {
    let (form, encoding) = match (form_of(&request), declared_encoding(request.headers())) {
        (Some(Ok(form)), Ok(encoding)) => (form, encoding),
        (Some(Err(faults)), _) => return Err(refuse(request, context, faults.into())),
        (None, _) => {
            let imported = ImportFormat::ALL.map(|format| format!("`{}`", format.media_type())).join(", ");
            let detail = "send JSON with the header `content-type: application/json`, or `application/x-ndjson`";
            let detail = format!("{detail}; or a file of another tool: {imported}");
            return Err(refuse(request, context, Problem::new(ProblemKind::UnsupportedMediaType, detail)));
        }
        (_, Err(problem)) => return Err(refuse(request, context, problem)),
    };
    let (collected, rest) = collect(open(request, sent, context)?, AT_HAND_BYTES, context).await?;
    let (bytes, held) = collected.into_parts();
    let open = |body: Box<dyn BufRead + Send>| -> OpenText { Box::new(move || encoding.decode(body, decoded)) };
    let (text, pump) = match rest {
        None if encoding == Encoding::Identity => (ModelText::Whole(bytes.into()), None),
        None => (ModelText::Packed(open(Box::new(io::Cursor::new(bytes)))), None),
        Some(rest) => {
            let (to_reader, reader) = pipe();
            (ModelText::Arriving(open(Box::new(reader))), Some(Pump { first: bytes, rest, to_reader }))
        }
    };
    Ok(SentModel { text, form, pump, held })
}

/// Carries the rest of a body to its reader.
pub(super) struct Pump {
    first: Bytes,
    rest: Arriving,
    to_reader: PipeWriter<Bytes>,
}

impl Pump {
    /// Ends when all was read, or the reader wants no more.
    pub(super) async fn run(self, context: &Context) {
        let Self { first, mut rest, to_reader } = self;
        let mut wants_more = to_reader.send(Ok(first)).await;
        while wants_more {
            let Some(chunk) = rest.next().await else { return to_reader.end().await };
            wants_more = chunk.is_ok() & to_reader.send(chunk.map_err(io::Error::from)).await;
        }
        rest.discard(context);
    }
}

/// A body on its way, which has a limit and a least speed.
struct Arriving {
    stream: BodyDataStream,
    limit: SentLimit,
    n_bytes: usize,
    /// How long the client was waited for.
    waited: Duration,
}

impl Arriving {
    fn new(stream: BodyDataStream, limit: SentLimit) -> Self {
        Self { stream, limit, n_bytes: 0, waited: Duration::ZERO }
    }

    /// The next chunk. After an error, there is none.
    async fn next(&mut self) -> Option<Result<Bytes, BodyError>> {
        let allowed = BODY_TIMEOUT + Duration::from_secs(self.n_bytes as u64 / MIN_BYTES_PER_S);
        // Only the client's time counts, not that of whoever asks.
        let asked = timer_now();
        let next = tokio::time::timeout(allowed.saturating_sub(self.waited), self.stream.next()).await;
        self.waited += asked.elapsed();
        Some(match next {
            Ok(None) => return None,
            Ok(Some(Ok(chunk))) => {
                self.n_bytes += chunk.len();
                if self.n_bytes <= self.limit.n_bytes { Ok(chunk) } else { Err(too_large(self.limit)) }
            }
            Ok(Some(Err(_))) => Err(BodyError::Incomplete),
            Err(_) => {
                let after = BODY_TIMEOUT.as_secs();
                Err(BodyError::Slow(format!("the body took over {after} s, at less than {MIN_BYTES_PER_S} bytes/s")))
            }
        })
    }

    /// Reads on beside the answer.
    fn discard(self, context: &Context) {
        let Self { stream, limit, waited, .. } = self;
        // A client that was too slow already is not waited for.
        if waited < BODY_TIMEOUT {
            discard(stream, limit.n_bytes, context);
        }
    }
}

/// A request that is complete without a body, and has none that a web page can send without asking.
pub(super) struct NoForm;

impl<S: Send + Sync> FromRequestParts<S> for NoForm {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        const FORMS: [&str; 3] = ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data"];
        let headers = &parts.headers;
        let has_body = headers.contains_key(TRANSFER_ENCODING)
            || headers.get(CONTENT_LENGTH).is_some_and(|length| length.as_bytes() != b"0");
        if has_body && FORMS.iter().any(|form| essence(headers).eq_ignore_ascii_case(form)) {
            return Err(Problem::new(ProblemKind::UnsupportedMediaType, "this is asked for without a body"));
        }
        Ok(Self)
    }
}

/// Refuses a request without a look at its body.
pub(super) fn refuse(request: Request, context: &Context, problem: Problem) -> Problem {
    // A client that sent `Expect: 100-continue` gets the answer instead.
    if !request.headers().contains_key(EXPECT) {
        discard(request.into_body().into_data_stream(), context.max_body_bytes, context);
    }
    problem
}

/// Whether a request declares that its body is NDJSON.
pub(super) fn is_ndjson(headers: &HeaderMap) -> bool {
    format_of(headers) == Some(Format::Ndjson)
}

/// The body, if it is not announced as too large.
fn open(request: Request, limit: SentLimit, context: &Context) -> Result<Arriving, Problem> {
    let announced =
        request.headers().get(CONTENT_LENGTH).and_then(|length| length.to_str().ok()?.parse::<usize>().ok());
    if announced.is_some_and(|length| length > limit.n_bytes) {
        return Err(refuse(request, context, Problem::from(&too_large(limit))));
    }
    Ok(Arriving::new(request.into_body().into_data_stream(), limit))
}

fn declared_encoding(headers: &HeaderMap) -> Result<Encoding, Problem> {
    Encoding::declared(headers).map_err(|encoding| {
        let detail = format!("the body is encoded as {}; send it as it is, or as gzip or zstd", Quoted(&encoding));
        Problem::new(ProblemKind::UnsupportedEncoding, detail)
    })
}

/// Reads until there are over `n_wanted` bytes; what is not read yet is given back.
async fn collect(
    mut body: Arriving,
    n_wanted: usize,
    context: &Context,
) -> Result<(Collected<'_>, Option<Arriving>), Problem> {
    let mut collected = Collected::new(context.etude.memory());
    while let Some(chunk) = body.next().await {
        if let Err(error) = chunk.and_then(|chunk| collected.add(chunk).map_err(BodyError::NoRoom)) {
            body.discard(context);
            return Err(Problem::from(&error));
        }
        if collected.n_bytes() > n_wanted {
            return Ok((collected, Some(body)));
        }
    }
    Ok((collected, None))
}

/// Reads the rest of a body that is not wanted, and throws it away.
fn discard(stream: BodyDataStream, limit: usize, context: &Context) {
    if stream.is_end_stream() {
        return;
    }
    let stopping = context.stopping.clone();
    context.tasks.spawn(async move {
        tokio::select! {
            () = throw_away(stream, limit) => {}
            () = stopping.cancelled() => {}
        }
    });
}

async fn throw_away(mut stream: BodyDataStream, limit: usize) {
    let reading = async {
        let mut n_left = limit.saturating_mul(MAX_DISCARDED_LIMITS);
        while let Some(Ok(chunk)) = stream.next().await {
            match n_left.checked_sub(chunk.len()) {
                Some(left) => n_left = left,
                None => return,
            }
        }
    };
    // Then the connection closes, as the rest is not read.
    let _ = tokio::time::timeout(DISCARD_TIMEOUT, reading).await;
}

fn too_large(limit: SentLimit) -> BodyError {
    let SentLimit { n_bytes, setting } = limit;
    BodyError::TooLarge(format!("the body has over {n_bytes} bytes, the limit of this service ({setting})"))
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use axum::body::Body;
    use futures_util::stream;

    use super::*;

    const LIMIT: SentLimit = SentLimit { n_bytes: 1 << 30, setting: "TEST" };

    /// A body of which a chunk of `n_bytes` comes after each `pause`.
    fn trickling(n_bytes: usize, pause: Duration) -> BodyDataStream {
        let chunks = stream::repeat(vec![b' '; n_bytes]).then(move |chunk| async move {
            tokio::time::sleep(pause).await;
            Ok::<_, Infallible>(chunk)
        });
        Body::from_stream(chunks).into_data_stream()
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_comes_too_slowly_is_not_waited_for() {
        let started = timer_now();
        let mut body = Arriving::new(trickling(1, Duration::from_secs(1)), LIMIT);
        let error = loop {
            if let Err(error) = body.next().await.unwrap() {
                break error;
            }
        };
        assert!(matches!(error, BodyError::Slow(_)), "{error}");
        assert_eq!(started.elapsed(), BODY_TIMEOUT);
    }

    #[tokio::test(start_paused = true)]
    async fn a_body_that_comes_steadily_may_take_its_time_and_so_may_its_reader() {
        let mut body = Arriving::new(trickling(64 * 1024, Duration::from_secs(1)), LIMIT);
        for _ in 0..1000 {
            body.next().await.unwrap().unwrap();
            tokio::time::sleep(Duration::from_secs(10)).await;
        }
    }

    #[tokio::test(start_paused = true)]
    async fn what_is_not_wanted_is_read_for_a_while_only() {
        let started = timer_now();
        throw_away(trickling(1, Duration::from_secs(1)), 1 << 20).await;
        assert_eq!(started.elapsed(), DISCARD_TIMEOUT);
        throw_away(trickling(1 << 20, Duration::from_millis(1)), 1 << 20).await;
        assert!(started.elapsed() < DISCARD_TIMEOUT * 2, "as many limits were read as are");
    }
}
