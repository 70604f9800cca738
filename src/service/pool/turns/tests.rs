//! Whose turn it is, without threads or clocks.

use std::net::{IpAddr, Ipv4Addr};

use jiff::Timestamp;
use proptest::prelude::*;

use super::*;
use crate::clock::Clock;

fn any_instant() -> Instant {
    Clock::stepped(Timestamp::UNIX_EPOCH).instant()
}

fn client(n: u8) -> Client {
    IpAddr::from(Ipv4Addr::new(10, 0, 0, n)).into()
}

/// All who wait are served, in this order, each when the one before has stopped.
fn order(turns: &mut Turns, class: Class, now: Instant) -> Vec<Ticket> {
    let mut order = Vec::new();
    turns.stop(client(0), class);
    while let Some((ticket, _)) = turns.next(now) {
        order.push(ticket);
        turns.stop(client(0), class);
    }
    order
}

#[test]
fn clients_take_turns_and_a_clients_jobs_keep_their_order() {
    let now = any_instant();
    let mut turns = Turns::new(2, 10, 10);
    while turns.try_start(client(0), Class::Short, now).is_some() {}
    let tickets = [0, 0, 0, 1, 1, 2].map(|n| turns.wait(client(n), Class::Short, 0));
    let [a1, a2, a3, b1, b2, c1] = tickets;
    assert_eq!(order(&mut turns, Class::Short, now), [a1, b1, c1, a2, b2, a3]);
}

#[test]
fn who_has_used_processors_least_of_late_is_next() {
    let long_ago = any_instant();
    let now = long_ago + Duration::from_secs(10);
    let mut turns = Turns::new(2, 10, 10);
    while turns.try_start(client(0), Class::Short, now).is_some() {}
    for (n, used_ms, at) in [(0, 20, now), (1, 2000, long_ago), (2, 10, now)] {
        turns.charge(client(n), Duration::from_millis(used_ms), at);
    }
    let tickets = [0, 0, 1, 1, 2, 2, 3].map(|n| turns.wait(client(n), Class::Short, 0));
    let [a1, a2, b1, b2, c1, c2, d1] = tickets;
    assert_eq!(order(&mut turns, Class::Short, now), [d1, b1, b2, c1, c2, a1, a2]);
}

#[test]
fn of_long_jobs_that_are_too_many_the_one_whose_client_has_used_most_makes_way() {
    let now = any_instant();
    let mut turns = Turns::new(2, 10, 10);
    turns.note_short(now);
    turns.charge(client(0), Duration::from_millis(500), now);
    turns.charge(client(1), Duration::from_millis(10), now);
    assert_eq!(turns.try_start(client(0), Class::Long, now), Some(Class::Long));
    assert_eq!(turns.try_start(client(1), Class::Short, now), Some(Class::Quick));
    assert_eq!(turns.try_start(client(0), Class::Short, now), Some(Class::Short));
    assert!(turns.become_long(client(1), Class::Quick, now), "there is one more until the other has seen it");
    assert!(turns.makes_way(client(0), 9, false, now) && !turns.makes_way(client(1), 1, false, now));
    assert!(!turns.become_long(client(0), Class::Short, now), "there is one more already");
    assert!(turns.makes_way(client(1), 1, false, now), "whoever sees it first");
    turns.stop(client(0), Class::Long);
    turns.stop(client(0), Class::Long);
    assert!(!turns.makes_way(client(1), 1, false, now));
}

#[test]
fn who_uses_little_has_threads_that_others_do_not_take() {
    let now = any_instant();
    let mut turns = Turns::new(2, 10, 10);
    turns.charge(client(0), Duration::from_secs(1), now);
    while turns.try_start(client(0), Class::Short, now).is_some() {}
    let first = turns.wait(client(0), Class::Short, 0);
    for _ in 0..2 {
        assert_eq!(turns.try_start(client(1), Class::Short, now), Some(Class::Quick));
    }
    assert_eq!(turns.try_start(client(1), Class::Short, now), None, "they are taken");
    let second = turns.wait(client(1), Class::Short, 0);
    turns.stop(client(1), Class::Quick);
    assert_eq!((turns.next(now), turns.next(now)), (Some((second, Class::Quick)), None));
    let later = now + Duration::from_secs(10);
    turns.stop(client(1), Class::Quick);
    assert_eq!(turns.next(later), Some((first, Class::Quick)), "what was used long ago counts little");
}

#[test]
fn short_jobs_come_before_long_ones_which_leave_them_a_thread() {
    let now = any_instant();
    let mut turns = Turns::new(3, 10, 10);
    assert_eq!(turns.try_start(client(0), Class::Short, now), Some(Class::Quick));
    assert!(turns.become_long(client(0), Class::Quick, now));
    assert!(turns.try_start(client(0), Class::Long, now).is_some());
    assert_eq!(turns.try_start(client(0), Class::Long, now), None, "the other threads are for short jobs");
    let long = turns.wait(client(0), Class::Long, 1);
    while turns.try_start(client(0), Class::Short, now).is_some() {}
    assert_eq!(turns.n_running, 3 + N_SHORT_THREADS);
    let short = turns.wait(client(0), Class::Short, 0);
    turns.stop(client(0), Class::Long);
    assert_eq!((turns.next(now), turns.next(now)), (Some((short, Class::Short)), None));
    turns.stop(client(0), Class::Short);
    assert_eq!((turns.next(now), turns.next(now)), (Some((long, Class::Long)), None));
}

#[test]
fn the_last_thread_is_lent_while_nothing_short_comes() {
    let now = any_instant();
    let later = now + LENT_AFTER;
    let mut turns = Turns::new(2, 10, 10);
    turns.note_short(now);
    assert!(turns.try_start(client(0), Class::Long, now).is_some());
    assert!(turns.try_start(client(0), Class::Long, now).is_none());
    assert!(turns.try_start(client(0), Class::Long, later).is_some());
    assert!(!turns.makes_way(client(0), 1, true, later));
    turns.note_short(later);
    assert!(turns.makes_way(client(0), 1, false, later));
    turns.stop(client(0), Class::Long);
    assert!(!turns.makes_way(client(0), 1, true, later));
    turns.wait(client(1), Class::Long, 1);
    assert!(turns.makes_way(client(0), 1, true, later) && !turns.makes_way(client(0), 1, false, later));
    assert!(!turns.makes_way(client(1), 1, true, later), "its own jobs wait for each other");
}

#[test]
fn of_a_clients_long_jobs_the_one_that_has_run_least_is_next() {
    let now = any_instant();
    let mut turns = Turns::new(2, 10, 10);
    turns.note_short(now);
    assert!(turns.try_start(client(0), Class::Long, now).is_some());
    let tickets = [3, 3, 1, 2].map(|level| turns.wait(client(0), Class::Long, level));
    assert!(turns.makes_way(client(0), 2, false, now) && !turns.makes_way(client(0), 1, false, now));
    let [third, fourth, first, second] = tickets;
    assert_eq!(order(&mut turns, Class::Long, now), [first, second, third, fourth]);
}

#[test]
fn a_client_may_have_as_many_places_as_it_leaves_to_others() {
    let mut turns = Turns::new(2, 16, 16);
    let mut fill = |n| (0..100).filter(|_| turns.admit(client(n), Class::Short)).count();
    assert_eq!([fill(0), fill(1), fill(2), fill(3), fill(4)], [9, 4, 2, 1, 0]);
    assert!(turns.admit(client(0), Class::Long));
    turns.leave(client(0), Class::Short);
    assert!(turns.admit(client(9), Class::Short));
}

#[derive(Clone, Copy, Debug)]
enum Action {
    Start(u8, bool),
    BecomeLong,
    Stop,
    GiveUp,
    Pass(u64),
    Charge(u8, u64),
}

fn actions() -> impl Strategy<Value = Vec<Action>> {
    let action = prop_oneof![
        6 => (0..4_u8, any::<bool>()).prop_map(|(client, is_long)| Action::Start(client, is_long)),
        2 => Just(Action::BecomeLong),
        4 => Just(Action::Stop),
        1 => Just(Action::GiveUp),
        1 => (0..15_u64).prop_map(Action::Pass),
        2 => (0..4_u8, 0..200_u64).prop_map(|(client, ms)| Action::Charge(client, ms)),
    ];
    proptest::collection::vec(action, 1..200)
}

proptest! {
    #[test]
    fn no_thread_is_lost_or_given_twice_and_none_idles_while_a_short_job_waits(actions in actions(), n_threads in 2..5_usize) {
        let mut now = any_instant();
        let mut turns = Turns::new(n_threads, 10, 10);
        let mut running = Vec::new();
        let mut waiting = Vec::new();
        for action in actions {
            match action {
                Action::Start(n, is_long) => {
                    let class = if is_long { Class::Long } else { Class::Short };
                    if let Some(class) = turns.try_start(client(n), class, now) {
                        running.push((client(n), class));
                    } else {
                        waiting.push((turns.wait(client(n), class, 1), client(n), class));
                    }
                }
                Action::BecomeLong => {
                    if let Some(at) = running.iter().position(|(_, class)| *class != Class::Long) {
                        let (client, class) = &mut running[at];
                        let class = std::mem::replace(class, Class::Long);
                        if !turns.become_long(*client, class, now) {
                            turns.stop(*client, Class::Long);
                            running.remove(at);
                        }
                    }
                }
                Action::Stop => {
                    if let Some((client, class)) = running.pop() {
                        turns.stop(client, class);
                    }
                }
                Action::GiveUp => {
                    if let Some((ticket, client, class)) = waiting.pop() {
                        prop_assert!(turns.give_up(client, class, ticket));
                        prop_assert!(!turns.give_up(client, class, ticket));
                    }
                }
                Action::Pass(ms) => now += Duration::from_millis(ms),
                Action::Charge(n, ms) => turns.charge(client(n), Duration::from_millis(ms), now),
            }
            while let Some((ticket, class)) = turns.next(now) {
                let at = waiting.iter().position(|(waiting, ..)| *waiting == ticket);
                prop_assert!(at.is_some(), "nobody waits with this ticket");
                running.push((waiting.remove(at.unwrap()).1, class));
            }
            let n_of = |wanted| running.iter().filter(|(_, class)| *class == wanted).count();
            let (n_quick, n_short, n_long) = (n_of(Class::Quick), n_of(Class::Short), n_of(Class::Long));
            prop_assert!(n_quick <= n_threads && n_short <= n_threads + N_SHORT_THREADS);
            prop_assert!(n_long <= n_threads + 1, "one more until it has made way");
            let are_all_taken = n_short + n_long >= n_threads + N_SHORT_THREADS;
            let waits = |wanted| waiting.iter().any(|(.., class)| *class == wanted);
            prop_assert!(are_all_taken || !waits(Class::Short));
            prop_assert!(are_all_taken || n_long + 1 >= n_threads || !waits(Class::Long));
        }
        // Whoever still waits is served in the end.
        now += LENT_AFTER;
        while let Some((client, class)) = running.pop() {
            turns.stop(client, class);
            while let Some((ticket, class)) = turns.next(now) {
                let at = waiting.iter().position(|(waiting, ..)| *waiting == ticket).unwrap();
                running.push((waiting.remove(at).1, class));
            }
        }
        prop_assert!(waiting.is_empty() && turns.n_running == 0 && turns.n_quick == 0 && turns.running_long.is_empty());
    }
}
