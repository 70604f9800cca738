//! What fits, what waits, and what the machine is found to have.

use futures_util::poll;

use super::*;

const MIB: u64 = 1 << 20;

#[test]
fn what_is_held_is_given_back_when_it_is_dropped() {
    let memory = Memory::with_room(MIB);
    let held = memory.try_take(MIB - 1).unwrap();
    assert_eq!((held.n_bytes(), memory.free()), (MIB, 0));
    assert_eq!(memory.try_take(1).unwrap_err(), NoRoom { wanted: 1, room: MIB });
    drop(held);
    assert_eq!(memory.free(), MIB);
}

#[test]
fn what_is_held_grows_if_there_is_room_and_shrinks() {
    let memory = Memory::with_room(MIB);
    let mut held = memory.try_take(0).unwrap();
    held.grow_to(MIB / 2).unwrap();
    assert_eq!(held.grow_to(2 * MIB), Err(NoRoom { wanted: 2 * MIB, room: MIB }));
    let other = memory.try_take(MIB / 2).unwrap();
    assert!(held.grow_to(MIB / 2 + 1).is_err());
    assert_eq!((held.n_bytes(), memory.free()), (MIB / 2, 0));
    held.shrink_to(5000);
    assert_eq!((held.n_bytes(), memory.free()), (8192, MIB / 2 - 8192));
    drop((held, other));
    assert_eq!(memory.free(), MIB);
}

#[test]
fn what_is_little_need_not_be_counted() {
    let memory = Memory::with_room(MIB);
    let mut held = None;
    memory.reserve(&mut held, 64 << 10).unwrap();
    assert!(held.is_none());
    memory.reserve(&mut held, (64 << 10) + 1).unwrap();
    memory.reserve(&mut held, 512 << 10).unwrap();
    assert!(memory.reserve(&mut held, 2 << 20).is_err());
    assert_eq!((held.unwrap().n_bytes(), memory.free()), (MIB / 2, MIB / 2));
}

#[test]
fn what_is_large_leaves_an_eighth_to_what_is_small() {
    let memory = Memory::with_room(16 * MIB);
    assert!(memory.try_take(14 * MIB + 1).is_err());
    let mut large = memory.try_take(14 * MIB).unwrap();
    assert!(large.grow_to(15 * MIB).is_err() && memory.try_take(MIB + 1).is_err());
    let small = [MIB, MIB].map(|n_bytes| memory.try_take(n_bytes).unwrap());
    assert_eq!(memory.free(), 0);
    drop((large, small));
    assert_eq!((memory.free(), memory.free_for_large()), (16 * MIB, 14 * MIB));
}

#[test]
fn nothing_large_is_begun_while_most_of_the_memory_is_resident() {
    let memory = Memory::new(320 * MIB);
    assert!(memory.try_take(100 * MIB).is_ok());
    memory.note_resident(270 * MIB);
    assert!(memory.try_take(11 * MIB).is_err(), "seven eighths are 280");
    let mut large = memory.try_take(10 * MIB).unwrap();
    memory.note_resident(300 * MIB);
    assert!(memory.try_take(SMALL_BYTES).is_ok(), "what is small is answered");
    assert!(large.grow_to(11 * MIB).is_err());
    memory.note_resident(20 * MIB);
    assert!(large.grow_to(11 * MIB).is_ok());
    assert!((MIB..1 << 40).contains(&resident_bytes(&File::open(STATM).unwrap()).unwrap()));
}

#[tokio::test(start_paused = true)]
async fn who_waits_for_much_gets_it_in_the_end_and_keeps_nobody_waiting() {
    let memory = Memory::with_room(16 * MIB);
    let [half, quarter] = [8, 4].map(|n| memory.try_take(n * MIB).unwrap());
    let mut much = Box::pin(memory.take(12 * MIB));
    assert!(poll!(&mut much).is_pending());
    let little = memory.try_take(2 * MIB).unwrap();
    assert!(poll!(Box::pin(memory.take(1))).is_pending(), "the rest is for what is small");
    drop(half);
    assert!(poll!(&mut much).is_pending(), "it is not enough");
    drop(memory.try_take(8 * MIB).unwrap());
    drop(little);
    drop(quarter);
    assert_eq!(much.await.unwrap().n_bytes(), 12 * MIB);
    assert!(memory.take(14 * MIB + 1).await.is_err(), "it would wait for ever");
}

#[tokio::test]
async fn who_waits_is_told_of_what_is_no_longer_needed() {
    let memory = Memory::with_room(MIB);
    let mut held = memory.try_take(MIB / 2).unwrap();
    let mut waiting = Box::pin(memory.take(MIB / 2));
    assert!(poll!(&mut waiting).is_pending(), "an eighth is left to what is small");
    held.shrink_to(MIB / 4);
    assert!(waiting.await.is_ok());
    let memory = Memory::new(320 * MIB);
    memory.note_resident(300 * MIB);
    let mut waiting = Box::pin(memory.take(2 * MIB));
    assert!(poll!(&mut waiting).is_pending());
    memory.note_resident(20 * MIB);
    assert!(waiting.await.is_ok(), "less is resident");
}

#[test]
fn a_process_may_use_a_part_of_what_there_is() {
    let machine = machine_bytes().unwrap();
    assert!((1..machine).contains(&default_max_bytes()));
}
