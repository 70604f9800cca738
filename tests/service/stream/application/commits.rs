//! How often is written to the disk.

use super::*;

/// How many commits are in the log of the database: frames that say how large the database is then
/// (<https://www.sqlite.org/fileformat2.html#walformat>).
fn n_logged(directory: &TempDir) -> usize {
    let log = std::fs::read(directory.path().join("etude.db-wal")).unwrap();
    let (header, frames) = log.split_at(32);
    let page_bytes = u32::from_be_bytes(header[8..12].try_into().unwrap()) as usize;
    let is_commit = |frame: &&[u8]| frame[8..16] == header[16..24] && frame[4..8] != [0; 4];
    frames.chunks_exact(24 + page_bytes).filter(is_commit).count()
}

#[tokio::test]
async fn frames_that_wait_one_behind_the_other_take_one_commit() {
    let (service, demonstration) = figure_4().await;
    let (etude, directory) = without_service(service, &CancellationToken::new()).await;
    let (etude, stopping) = (Arc::new(etude), CancellationToken::new());
    let mut wire = Wire::connect(&etude, &stopping);
    wire.send(json!({"type": "open", "model": "figure-4"})).await;
    wire.receive_until("opened").await;
    let n_before = n_logged(&directory);
    for (seq, state) in demonstration.iter().enumerate() {
        wire.send(json!({"type": "observe", "seq": seq, "states": [state]})).await;
    }
    for seq in 1..=demonstration.len() {
        assert_eq!(wire.receive_until("received").await["seq"], seq);
    }
    assert_eq!(n_logged(&directory) - n_before, 1);
    etude.close().await;
}

#[tokio::test]
async fn an_end_that_waits_behind_the_last_observations_is_written_with_them() {
    let (service, demonstration) = figure_4().await;
    // By a clock that stands still, nothing takes long.
    let (clock, stopping) = (Clock::stepped(Timestamp::UNIX_EPOCH), CancellationToken::new());
    let (etude, directory) = by_clock(service, &stopping, clock).await;
    let etude = Arc::new(etude);
    for (are_sent_together, n_commits) in [(false, demonstration.len() + 1), (true, 1)] {
        let mut wire = Wire::connect(&etude, &stopping);
        wire.send(json!({"type": "open", "model": "figure-4"})).await;
        let session = wire.receive_until("opened").await["session"].take();
        let n_before = n_logged(&directory);
        for (seq, state) in demonstration.iter().enumerate() {
            wire.send(json!({"type": "observe", "seq": seq, "states": [state]})).await;
            if !are_sent_together {
                wire.receive_until("received").await;
            }
        }
        wire.send(json!({"type": "end", "seq": demonstration.len()})).await;
        let done = wire.receive_until("done").await;
        assert_eq!(n_logged(&directory) - n_before, n_commits);
        let row = etude.session(session.as_str().unwrap()).await.unwrap();
        assert_eq!((row.status.name(), row.n_observations), ("done", 16));
        assert_eq!(row.policy_id.as_deref(), done["policy_id"].as_str());
    }
    etude.close().await;
}
