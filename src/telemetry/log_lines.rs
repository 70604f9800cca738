//! Log lines on their way out.
//!
//! A line that is written at once costs a system call, and threads that log at the same time wait for each other in it. So lines
//! gather in memory, and one thread writes all that there are: the first one at once, the next ones not before some time has
//! passed, or at once if one of them warns of something.
//!
//! ```text
//! lines --> waiting (bounded) --(a thread, every WRITE_EVERY)--> out
//!              +--> dropped and counted, while nobody takes them away
//! ```
//!
//! Logging never waits for the reader of the log: else a full pipe would stop the whole service. Lines for which there is no room are
//! dropped, warnings included. Their number is measured (`etude_log_lines_dropped_total`) and logged once the reader goes on.
//!
//! This is not `tracing-appender`, which does the same as fast: where lines are stuck at the end of the process, it says so on
//! standard output, and waits for ever if that leads into the same pipe.

use std::io::{self, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tracing::{Level, Metadata};
use tracing_subscriber::fmt::MakeWriter;

/// How long a line may wait for others: too short for a reader to notice.
const WRITE_EVERY: Duration = Duration::from_millis(10);

/// Most bytes of lines that wait to be written, some 16,000 lines: a second of a busy service. While they are written, as many wait again.
const MAX_WAITING_BYTES: usize = 4 << 20;

/// How long the end of the process waits for lines to be written.
const FLUSH_TIMEOUT: Duration = Duration::from_secs(1);

/// Where log lines are written to.
#[derive(Clone)]
pub(super) struct LogLines(Arc<Queue>);

#[derive(Default)]
struct Queue {
    waiting: Mutex<Waiting>,
    /// Some wait that are to be written.
    has_some: Condvar,
    /// Some were written.
    has_written: Condvar,
}

#[derive(Default)]
struct Waiting {
    lines: Vec<u8>,
    /// Lines that found no room since this was last told.
    n_dropped: u64,
    /// Whether what waits is written without waiting for more.
    is_urgent: bool,
    /// Whether lines that were taken out are not written yet.
    is_writing: bool,
}

impl LogLines {
    /// Lines that end up in `writer`.
    ///
    /// # Errors
    ///
    /// If there can be no thread that writes them.
    pub(super) fn start(mut writer: impl Write + Send + 'static) -> io::Result<Self> {
        let lines = Arc::new(Queue::default());
        let writing = Arc::clone(&lines);
        // It ends with the process.
        std::thread::Builder::new().name("log".to_owned()).spawn(move || {
            let mut taken = Vec::new();
            loop {
                writing.take(&mut taken);
                if writer.write_all(&taken).and_then(|()| writer.flush()).is_err() {
                    // Only the measurements can show that logging fails.
                    count_dropped(taken.split(|byte| *byte == b'\n').skip(1).count() as u64);
                }
                writing.wait_for_more();
            }
        })?;
        Ok(Self(lines))
    }

    /// Waits until all that was logged is written, but not for long.
    pub(super) fn flush(&self) {
        self.0.flush();
    }
}

impl Queue {
    /// Adds a line if there is room for it. Never waits for a writer.
    fn add(&self, line: &[u8], is_urgent: bool) {
        let mut waiting = self.lock();
        if waiting.lines.len() + line.len() > MAX_WAITING_BYTES {
            waiting.n_dropped += 1;
            drop(waiting);
            return count_dropped(1);
        }
        let is_first = waiting.lines.is_empty();
        let becomes_urgent = is_urgent && !waiting.is_urgent;
        waiting.lines.extend_from_slice(line);
        waiting.is_urgent |= is_urgent;
        drop(waiting);
        if is_first || becomes_urgent {
            self.has_some.notify_one();
        }
    }

    /// Waits for lines, and exchanges them for `taken`, which is emptied.
    fn take(&self, taken: &mut Vec<u8>) {
        taken.clear();
        let is_empty = |waiting: &mut Waiting| waiting.lines.is_empty();
        let mut waiting = self.has_some.wait_while(self.lock(), is_empty).unwrap_or_else(PoisonError::into_inner);
        std::mem::swap(&mut waiting.lines, taken);
        waiting.is_urgent = false;
        waiting.is_writing = true;
        let n_dropped = std::mem::take(&mut waiting.n_dropped);
        drop(waiting);
        if n_dropped > 0 {
            // It finds room, as all that waited was just taken.
            tracing::warn!(n_dropped, "log lines were dropped, as those before them were not taken away");
        }
    }

    /// Tells that what was taken is written, and gives further lines some time to gather.
    fn wait_for_more(&self) {
        let mut waiting = self.lock();
        waiting.is_writing = false;
        self.has_written.notify_all();
        drop(self.has_some.wait_timeout_while(waiting, WRITE_EVERY, |waiting| !waiting.is_urgent));
    }

    fn flush(&self) {
        let mut waiting = self.lock();
        waiting.is_urgent = true;
        self.has_some.notify_one();
        let is_on_its_way = |waiting: &mut Waiting| waiting.is_writing || !waiting.lines.is_empty();
        drop(self.has_written.wait_timeout_while(waiting, FLUSH_TIMEOUT, is_on_its_way));
    }

    /// What a panic has left behind is whole lines.
    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn count_dropped(n_lines: u64) {
    metrics::counter!("etude_log_lines_dropped_total").increment(n_lines);
}

/// Writes a line.
pub(super) struct LineWriter<'l> {
    lines: &'l Queue,
    is_urgent: bool,
}

impl Write for LineWriter<'_> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.lines.add(line, self.is_urgent);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl<'l> MakeWriter<'l> for LogLines {
    type Writer = LineWriter<'l>;

    fn make_writer(&'l self) -> LineWriter<'l> {
        LineWriter { lines: &self.0, is_urgent: true }
    }

    fn make_writer_for(&'l self, metadata: &Metadata<'_>) -> LineWriter<'l> {
        LineWriter { lines: &self.0, is_urgent: *metadata.level() <= Level::WARN }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    /// Tells what is written at a time, as soon as that is taken.
    struct Told(mpsc::SyncSender<String>);

    impl Write for Told {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.send(String::from_utf8_lossy(bytes).into_owned()).map_err(io::Error::other)?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    /// Lines of which so many writes are taken before somebody reads.
    fn told(n_taken: usize) -> (LogLines, mpsc::Receiver<String>) {
        let (sender, written) = mpsc::sync_channel(n_taken);
        (LogLines::start(Told(sender)).unwrap(), written)
    }

    #[test]
    fn a_line_is_written_without_another_one() {
        let (lines, written) = told(1);
        lines.0.add(b"listening\n", false);
        assert_eq!(written.recv().unwrap(), "listening\n");
        lines.0.add(b"stopped\n", false);
        assert_eq!(written.recv().unwrap(), "stopped\n");
    }

    #[test]
    fn all_lines_are_out_in_order_once_they_are_flushed() {
        let (lines, written) = told(2000);
        for n in 0..1000 {
            lines.0.add(format!("line {n}\n").as_bytes(), n % 100 == 0);
        }
        lines.flush();
        let out: String = written.try_iter().collect();
        let expected: Vec<_> = (0..1000).map(|n| format!("line {n}")).collect();
        assert_eq!(out.lines().collect::<Vec<_>>(), expected);
    }

    /// With a writer that is stuck for good, this would not end if anybody waited for it.
    #[test]
    fn who_logs_what_nobody_takes_away_does_not_wait_and_what_finds_no_room_is_dropped() {
        let (lines, written) = told(0);
        lines.0.add(b"first\n", false);
        while !lines.0.lock().is_writing {
            std::thread::yield_now();
        }
        let line = vec![b'x'; MAX_WAITING_BYTES / 4];
        for n in 0..10 {
            lines.0.add(&line, n % 2 == 0);
        }
        let (n_bytes, n_dropped) = {
            let waiting = lines.0.lock();
            (waiting.lines.len(), waiting.n_dropped)
        };
        assert_eq!((n_bytes, n_dropped), (MAX_WAITING_BYTES, 6));
        lines.flush();
        // Once somebody reads, what has found room is there.
        assert_eq!(written.recv().unwrap(), "first\n");
        assert_eq!(written.recv().unwrap().len(), MAX_WAITING_BYTES);
    }
}
