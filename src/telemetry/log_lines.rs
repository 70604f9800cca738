//! Log lines on their way out.
//!
//! A line that is written at once costs a system call, and threads that log at the same time wait for each other in it. So lines
//! gather, and a thread writes all that there are: the first one at once, the next ones not before some time has passed. What
//! warns of something takes all before it along and is out before its thread goes on; so is what was logged before the end.
//!
//! ```text
//! lines --> gathered --(thread, every WRITE_EVERY)--> out
//!              +---(a warning, the end, too many)------^
//! ```

use std::io::{self, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tracing::{Level, Metadata};
use tracing_subscriber::fmt::MakeWriter;

/// How long a line may wait for others. Whoever reads along does not notice it.
const WRITE_EVERY: Duration = Duration::from_millis(10);

/// Lines are written by whoever logs once they take this much: where they are not taken away as fast as they come, logging waits.
const MAX_GATHERED_BYTES: usize = 256 * 1024;

/// Where log lines are written to.
#[derive(Clone)]
pub(super) struct LogLines(Arc<Lines>);

struct Lines {
    gathered: Mutex<Vec<u8>>,
    has_some: Condvar,
    out: Mutex<Out>,
}

struct Out {
    writer: Box<dyn Write + Send>,
    /// What is just being written; empty, but with the space that it took, between two times.
    lines: Vec<u8>,
}

impl LogLines {
    /// Lines that end up in `writer`.
    ///
    /// # Errors
    ///
    /// If there can be no thread that writes them.
    pub(super) fn start(writer: impl Write + Send + 'static) -> io::Result<Self> {
        let out = Mutex::new(Out { writer: Box::new(writer), lines: Vec::new() });
        let lines = Arc::new(Lines { gathered: Mutex::default(), has_some: Condvar::new(), out });
        let writing = Arc::clone(&lines);
        // It ends with the process.
        std::thread::Builder::new().name("log".to_owned()).spawn(move || {
            loop {
                let is_empty = |gathered: &mut Vec<u8>| gathered.is_empty();
                drop(writing.has_some.wait_while(lock(&writing.gathered), is_empty));
                writing.flush();
                std::thread::sleep(WRITE_EVERY);
            }
        })?;
        Ok(Self(lines))
    }

    /// Writes all that was logged.
    pub(super) fn flush(&self) {
        self.0.flush();
    }
}

impl Lines {
    fn add(&self, line: &[u8], is_urgent: bool) {
        let mut gathered = lock(&self.gathered);
        let was_empty = gathered.is_empty();
        gathered.extend_from_slice(line);
        let is_full = gathered.len() >= MAX_GATHERED_BYTES;
        drop(gathered);
        if is_urgent || is_full {
            self.flush();
        } else if was_empty {
            self.has_some.notify_one();
        }
    }

    fn flush(&self) {
        // Before the lines are taken, so that those taken later are written later.
        let mut out = lock(&self.out);
        let Out { writer, lines } = &mut *out;
        std::mem::swap(lines, &mut lock(&self.gathered));
        // There is nowhere to tell that nothing can be told.
        let _ = writer.write_all(lines).and_then(|()| writer.flush());
        lines.clear();
    }
}

/// What a panic has left behind is whole lines.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Writes a line.
pub(super) struct LineWriter<'l> {
    lines: &'l Lines,
    is_urgent: bool,
}

impl Write for LineWriter<'_> {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.lines.add(line, self.is_urgent);
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        self.lines.flush();
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

    /// Tells what is written at a time.
    struct Told(mpsc::Sender<String>);

    impl Write for Told {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.send(String::from_utf8_lossy(bytes).into_owned()).map_err(io::Error::other)?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    fn told() -> (LogLines, mpsc::Receiver<String>) {
        let (sender, written) = mpsc::channel();
        (LogLines::start(Told(sender)).unwrap(), written)
    }

    #[test]
    fn a_line_is_written_without_another_one() {
        let (lines, written) = told();
        lines.0.add(b"listening\n", false);
        assert_eq!(written.recv().unwrap(), "listening\n");
        lines.0.add(b"stopped\n", false);
        assert_eq!(written.recv().unwrap(), "stopped\n");
    }

    #[test]
    fn a_warning_and_all_before_it_is_out_before_its_thread_goes_on() {
        let (lines, written) = told();
        for n in 0..1000 {
            lines.0.add(format!("line {n}\n").as_bytes(), false);
        }
        lines.0.add(b"warning\n", true);
        let out: String = written.try_iter().collect();
        let expected: Vec<_> = (0..1000).map(|n| format!("line {n}")).chain(["warning".to_owned()]).collect();
        assert_eq!(out.lines().collect::<Vec<_>>(), expected);
    }

    #[test]
    fn whoever_logs_more_than_is_taken_away_waits() {
        let (lines, written) = told();
        let line = vec![b'x'; MAX_GATHERED_BYTES];
        lines.0.add(&line, false);
        assert_eq!(written.try_iter().map(|out| out.len()).sum::<usize>(), MAX_GATHERED_BYTES);
    }
}
