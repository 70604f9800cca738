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
    turns.stop(class);
    while let Some(ticket) = turns.next(now) {
        order.push(ticket);
        turns.stop(class);
    }
    order
}

#[test]
fn clients_take_turns_and_a_clients_jobs_keep_their_order() {
    let now = any_instant();
    let mut turns = Turns::new(2, 10, 10);
    while turns.try_start(Class::Short, now) {}
    let tickets = [0, 0, 0, 1, 1, 2].map(|n| turns.wait(client(n), Class::Short, 0));
    let [a1, a2, a3, b1, b2, c1] = tickets;
    assert_eq!(order(&mut turns, Class::Short, now), [a1, b1, c1, a2, b2, a3]);
}

#[test]
fn short_jobs_come_before_long_ones_which_leave_them_a_thread() {
    let now = any_instant();
    let mut turns = Turns::new(3, 10, 10);
    assert!(turns.try_start(Class::Short, now));
    assert!(turns.become_long(now) && turns.try_start(Class::Long, now));
    assert!(!turns.try_start(Class::Long, now), "the other threads are for short jobs");
    let long = turns.wait(client(0), Class::Long, 1);
    while turns.try_start(Class::Short, now) {}
    assert_eq!(turns.n_running(), 3 + N_SHORT_THREADS);
    let short = turns.wait(client(0), Class::Short, 0);
    turns.stop(Class::Long);
    assert_eq!((turns.next(now), turns.next(now)), (Some(short), None));
    turns.stop(Class::Short);
    assert_eq!((turns.next(now), turns.next(now)), (Some(long), None));
}

#[test]
fn the_last_thread_is_lent_while_nothing_short_comes() {
    let now = any_instant();
    let later = now + LENT_AFTER;
    let mut turns = Turns::new(2, 10, 10);
    turns.note_short(now);
    assert!(turns.try_start(Class::Long, now) && !turns.try_start(Class::Long, now));
    assert!(turns.try_start(Class::Long, later));
    assert!(!turns.makes_way(client(0), 1, true, later));
    turns.note_short(later);
    assert!(turns.makes_way(client(0), 1, false, later));
    turns.stop(Class::Long);
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
    assert!(turns.try_start(Class::Long, now));
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
}

fn actions() -> impl Strategy<Value = Vec<Action>> {
    let action = prop_oneof![
        6 => (0..4_u8, any::<bool>()).prop_map(|(client, is_long)| Action::Start(client, is_long)),
        2 => Just(Action::BecomeLong),
        4 => Just(Action::Stop),
        1 => Just(Action::GiveUp),
        1 => (0..15_u64).prop_map(Action::Pass),
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
                    if turns.try_start(class, now) {
                        running.push(class);
                    } else {
                        waiting.push((turns.wait(client(n), class, 1), client(n), class));
                    }
                }
                Action::BecomeLong => {
                    if let Some(class) = running.iter_mut().find(|class| **class == Class::Short) {
                        *class = Class::Long;
                        if !turns.become_long(now) {
                            turns.stop(Class::Long);
                            running.remove(running.iter().position(|class| *class == Class::Long).unwrap());
                        }
                    }
                }
                Action::Stop => {
                    if let Some(class) = running.pop() {
                        turns.stop(class);
                    }
                }
                Action::GiveUp => {
                    if let Some((ticket, client, class)) = waiting.pop() {
                        prop_assert!(turns.give_up(client, class, ticket));
                        prop_assert!(!turns.give_up(client, class, ticket));
                    }
                }
                Action::Pass(ms) => now += Duration::from_millis(ms),
            }
            while let Some(ticket) = turns.next(now) {
                let at = waiting.iter().position(|(waiting, ..)| *waiting == ticket);
                prop_assert!(at.is_some(), "nobody waits with this ticket");
                running.push(waiting.remove(at.unwrap()).2);
            }
            prop_assert!(running.len() <= n_threads + N_SHORT_THREADS);
            let waits = |wanted| waiting.iter().any(|(.., class)| *class == wanted);
            prop_assert!(running.len() == n_threads + N_SHORT_THREADS || !waits(Class::Short));
            let n_long = running.iter().filter(|class| **class == Class::Long).count();
            prop_assert!(n_long <= n_threads);
            prop_assert!(running.len() == n_threads + N_SHORT_THREADS || n_long + 1 >= n_threads || !waits(Class::Long));
        }
        // Whoever still waits is served in the end.
        now += LENT_AFTER;
        while let Some(class) = running.pop() {
            turns.stop(class);
            while let Some(ticket) = turns.next(now) {
                running.push(waiting.remove(waiting.iter().position(|(waiting, ..)| *waiting == ticket).unwrap()).2);
            }
        }
        prop_assert!(waiting.is_empty() && turns.n_running == 0 && turns.n_running_long == 0);
    }
}
