//! Tallies that are kept, and go on.

use proptest::prelude::*;
use serde_json::{Value, json};

use super::{add, batches, compiled, definition, log, tally};
use etude_core::interrupt::Uninterrupted;
use etude_core::model::Tally;

proptest! {
    #![proptest_config(ProptestConfig { cases: 200, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_tally_that_was_kept_goes_on_as_if_it_had_counted_all(log in log(80), n_kept in 0usize..10, min_count in 1u64..5) {
        let dynamics = json!({
            "kind": "experience", "bin": {"x": 0.5, "heading": 120}, "min_count": min_count,
            "unsafe": [{"x": 0, "heading": 120, "door": "open"}], "start": [{"x": 0.5, "heading": 240, "door": "shut"}],
        });
        let definition = definition(&dynamics);
        let (mut all, mut kept) = (tally(&definition), tally(&definition));
        for (n, batch) in batches(&log, 8).iter().enumerate() {
            if n == n_kept {
                kept = restored(&definition, &postcard::to_allocvec(&kept.kept()).unwrap()).unwrap();
            }
            add(&mut all, batch);
            add(&mut kept, batch);
            prop_assert_eq!(kept.counts(), all.counts());
        }
        kept = restored(&definition, &postcard::to_allocvec(&kept.kept()).unwrap()).unwrap();
        prop_assert_eq!(kept.counts(), all.counts());
        let texts = [all, kept].map(|tally| tally.definition(&mut Uninterrupted).unwrap().map(|table| table.text()));
        prop_assert_eq!(&texts[0], &texts[1]);
    }

    #[test]
    fn what_is_no_tally_of_a_model_is_refused_and_nothing_panics(log in log(20), at in any::<prop::sample::Index>(), byte: u8) {
        let definition = definition(&json!({"kind": "experience", "unsafe": [{"x": 0, "heading": 120, "door": "open"}]}));
        let mut told = tally(&definition);
        for batch in &batches(&log, 8) {
            add(&mut told, batch);
        }
        let mut bytes = postcard::to_allocvec(&told.kept()).unwrap();
        let at = at.index(bytes.len());
        bytes[at] = byte;
        if let Some(restored) = restored(&definition, &bytes) {
            // What it says of itself is true.
            let table = restored.definition(&mut Uninterrupted).unwrap();
            let n_states = table.map_or(0, |_| compiled(&restored).states().len());
            prop_assert!(n_states == 0 || n_states as usize == restored.counts().n_states);
        }
    }
}

fn restored(definition: &Value, kept: &[u8]) -> Option<Tally> {
    tally(definition).with_kept(postcard::from_bytes(kept).ok()?)
}
