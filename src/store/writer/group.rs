//! How a group of requests becomes durable: in one statement where that suffices, else in one transaction.

use sqlx::SqliteConnection;

use super::verb::{Effects, Job, Writing};
use crate::store::arrivals::Arrivals;
use crate::store::observations::SessionRefusal;
use crate::store::statements::Statements;
use crate::store::trials::{NewReward, NewTrial, Opened, RewardAnswer};
use crate::store::{
    NewObservations, NewPolicy, NewSession, SessionEnd, StoreError, policies, refinements, sessions, trials,
};

/// Applies `group`: durable when this returns.
pub(super) async fn write(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &mut [Job],
    was_interrupted: bool,
) -> Result<Effects, StoreError> {
    if append_at_once(connection, arrivals, group).await?
        || end_sessions_at_once(connection, arrivals, group).await?
        || add_policies_at_once(connection, group).await?
        || accept_rewards_at_once(connection, group).await?
        || open_sessions_at_once(connection, arrivals, group).await?
    {
        return Ok(Effects::default());
    }
    transact(connection, arrivals, group, was_interrupted).await
}

/// The observations in a group, in order, with those that come with the end of their session.
fn observations(group: &[Job]) -> Vec<&NewObservations> {
    let new = group.iter().filter_map(|job| match job {
        Job::Observations(asked) => Some(&asked.request),
        Job::End(asked) => asked.request.last.as_ref(),
        _ => None,
    });
    new.collect()
}

/// Appends observations in one statement, if there is nothing else in the group, all of them come next as far as is known, and nobody
/// else has written meanwhile. Says whether it did; it has done nothing otherwise.
async fn append_at_once(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &mut [Job],
) -> Result<bool, StoreError> {
    let are_all = group.iter().all(|job| matches!(job, Job::Observations(_)));
    if !are_all || !arrivals.is_known() || arrivals.is_full() {
        return Ok(false);
    }
    let news = observations(group);
    let accepted = arrivals.accept(&mut Statements::on(connection), &news).await?;
    if accepted.answers.iter().any(Result::is_err) || !arrivals.add_at_once(connection, &news, &accepted).await? {
        // The transaction that follows finds out why.
        arrivals.forget();
        return Ok(false);
    }
    answer_observations(group, accepted.answers);
    Ok(true)
}

/// Sessions whose last observations are refused do not end.
fn answer_observations(group: &mut [Job], answers: Vec<Result<(), SessionRefusal>>) {
    let mut answers = answers.into_iter();
    for job in group {
        match job {
            Job::Observations(asked) => asked.answer = answers.next(),
            Job::End(asked) if asked.request.last.is_some() => {
                asked.answer = answers.next().filter(Result::is_err);
            }
            _ => {}
        }
    }
}

/// Ends sessions by two executions, if there is nothing else in the group but observations, and all of it is done as far as is known. Says
/// whether it was; it has done nothing otherwise.
async fn end_sessions_at_once(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &mut [Job],
) -> Result<bool, StoreError> {
    let are_all = group.iter().all(|job| matches!(job, Job::Observations(_) | Job::End(_)));
    if !are_all || !arrivals.is_known() || arrivals.is_full() {
        return Ok(false);
    }
    let (news, ends, statements) = (observations(group), ends(group), &mut Statements::on(connection));
    let accepted = arrivals.accept(statements, &news).await?;
    if accepted.answers.iter().any(Result::is_err) {
        arrivals.forget();
        return Ok(false);
    }
    statements.add("BEGIN IMMEDIATE");
    if sessions::end_all(statements, &ends, arrivals.data_version()).await?.contains(&false) {
        // The transaction that follows finds out why.
        arrivals.forget();
        statements.undo().await?;
        return Ok(false);
    }
    arrivals.add(statements, &news, &accepted, false).await?;
    statements.add("COMMIT");
    statements.run().await?;
    for end in ends {
        arrivals.ended(&end.session_id);
    }
    answer_observations(group, accepted.answers);
    for job in group {
        if let Job::End(asked) = job {
            asked.answer = Some(Ok(()));
        }
    }
    Ok(true)
}

/// The sessions that are ended in a group, in order, but for those that were refused.
fn ends(group: &[Job]) -> Vec<&SessionEnd> {
    let ends = group.iter().filter_map(|job| match job {
        Job::End(asked) if asked.answer.is_none() => Some(&*asked.request),
        _ => None,
    });
    ends.collect()
}

/// Ends the sessions in `group`.
async fn end_sessions(
    statements: &mut Statements<'_>,
    arrivals: &mut Arrivals,
    group: &mut [Job],
) -> Result<(), StoreError> {
    let ends = ends(group);
    if ends.is_empty() {
        return Ok(());
    }
    let have_ended = sessions::end_all(statements, &ends, None).await?;
    let mut answers = Vec::with_capacity(ends.len());
    for (end, has_ended) in ends.iter().zip(have_ended) {
        answers.push(if has_ended {
            arrivals.ended(&end.session_id);
            Ok(())
        } else {
            Err(sessions::refusal(statements.connection().await?, &end.session_id).await?)
        });
    }
    let mut answers = answers.into_iter();
    for job in group {
        match job {
            Job::End(asked) if asked.answer.is_none() => asked.answer = answers.next(),
            _ => {}
        }
    }
    Ok(())
}

/// Adds policies in one statement, if there is nothing else in the group and they fit. Says whether it did; it has done nothing
/// otherwise.
async fn add_policies_at_once(connection: &mut SqliteConnection, group: &mut [Job]) -> Result<bool, StoreError> {
    let is_all = |job: &Job| matches!(job, Job::Policies(asked) if asked.request.refinements.is_empty());
    let was_added = group.iter().all(is_all) && policies::add_at_once(connection, &added_policies(group)).await?;
    if was_added {
        answer_policies(group);
    }
    Ok(was_added)
}

/// The policies that come by themselves in a group, in order.
fn added_policies(group: &[Job]) -> Vec<&NewPolicy> {
    let added = group.iter().filter_map(|job| match job {
        Job::Policies(asked) => Some(&asked.request.policies),
        _ => None,
    });
    added.flatten().collect()
}

fn answer_policies(group: &mut [Job]) {
    for job in group {
        if let Job::Policies(asked) = job {
            asked.answer = Some(());
        }
    }
}

/// Applies `group` in one transaction, each kind together. As nobody was answered yet, the requests of a group may be applied in any order. What
/// need not be asked is executed together, with the beginning and the end of the transaction. After an error the connection is closed, which
/// undoes what was done.
async fn transact(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &mut [Job],
    was_interrupted: bool,
) -> Result<Effects, StoreError> {
    let mut effects = Effects::default();
    let statements = &mut Statements::on(connection);
    statements.add("BEGIN IMMEDIATE");
    append(statements, arrivals, group).await?;
    end_sessions(statements, arrivals, group).await?;
    open_trials(statements, group).await?;
    for job in &mut *group {
        match job {
            Job::Policies(asked) => {
                for refinement in &asked.request.refinements {
                    refinements::add(statements, refinement);
                }
            }
            Job::Other(verb) => {
                let effects = &mut effects;
                verb.apply(&mut Writing { statements, arrivals, effects, was_interrupted }).await?;
            }
            Job::Observations(_) | Job::Trial(_) | Job::Session(_) | Job::End(_) | Job::Reward(_) => {}
        }
    }
    accept_rewards(statements, group).await?;
    open_sessions(statements, arrivals, group).await?;
    policies::add_all(statements, &added_policies(group)).await?;
    answer_policies(group);
    statements.add("COMMIT");
    statements.run().await?;
    Ok(effects)
}

/// Appends the observations in `group`, and brings all to their table if somebody in it reads them.
async fn append(statements: &mut Statements<'_>, arrivals: &mut Arrivals, group: &mut [Job]) -> Result<(), StoreError> {
    let are_read = group.iter().any(|job| matches!(job, Job::Other(verb) if verb.reads_observations()));
    let news = observations(group);
    // A group without observations does not wait for them to be settled.
    if !are_read && news.is_empty() {
        return Ok(());
    }
    arrivals.check(statements).await?;
    if !arrivals.is_known() {
        arrivals.settle(statements).await?;
    }
    let accepted = arrivals.accept(statements, &news).await?;
    arrivals.add(statements, &news, &accepted, are_read).await?;
    answer_observations(group, accepted.answers);
    Ok(())
}

/// Stores the trials in `group`, in order.
async fn open_trials(statements: &mut Statements<'_>, group: &mut [Job]) -> Result<(), StoreError> {
    let mut asked: Vec<_> = group
        .iter_mut()
        .filter_map(|job| match job {
            Job::Trial(asked) => Some(asked),
            _ => None,
        })
        .collect();
    let new: Vec<&NewTrial> = asked.iter().map(|asked| &*asked.request).collect();
    let answers = trials::open_all(statements, &new).await?;
    for (asked, answer) in asked.iter_mut().zip(answers) {
        asked.answer = Some(answer);
    }
    Ok(())
}

/// Opens sessions in one statement, if there is nothing else in the group and none of them explores. Says whether it did; it has done nothing
/// otherwise.
async fn open_sessions_at_once(
    connection: &mut SqliteConnection,
    arrivals: &mut Arrivals,
    group: &mut [Job],
) -> Result<bool, StoreError> {
    let are_all = group.iter().all(|job| matches!(job, Job::Session(asked) if asked.request.trial.is_none()));
    if are_all {
        let statements = &mut Statements::on(connection);
        open_sessions(statements, arrivals, group).await?;
        statements.run().await?;
    }
    Ok(are_all)
}

/// Opens the sessions in `group`.
async fn open_sessions(
    statements: &mut Statements<'_>,
    arrivals: &mut Arrivals,
    group: &mut [Job],
) -> Result<(), StoreError> {
    let asked = group.iter_mut().filter_map(|job| match job {
        Job::Session(asked) => Some(asked),
        _ => None,
    });
    let mut asked: Vec<_> = asked.collect();
    let new: Vec<&NewSession> = asked.iter().map(|asked| &*asked.request).collect();
    let answers = sessions::open_all(statements, &new).await?;
    for (asked, answer) in asked.iter_mut().zip(answers) {
        if answer == Opened::Yes {
            arrivals.opened(&asked.request.id);
        }
        asked.answer = Some(answer);
    }
    Ok(())
}

/// The rewards in a group, in order.
fn rewards(group: &[Job]) -> Vec<&NewReward> {
    let rewards = group.iter().filter_map(|job| match job {
        Job::Reward(asked) => Some(&asked.request),
        _ => None,
    });
    rewards.collect()
}

/// Accepts rewards without a transaction, if there is nothing else in the group, as [`trials::accept_at_once`] does. Says whether it did; it
/// has done nothing otherwise.
async fn accept_rewards_at_once(connection: &mut SqliteConnection, group: &mut [Job]) -> Result<bool, StoreError> {
    let rewards = rewards(group);
    if rewards.len() < group.len() {
        return Ok(false);
    }
    let answers = trials::accept_at_once(connection, &rewards).await?;
    Ok(answers.map(|answers| answer_rewards(group, answers)).is_some())
}

/// Accepts the rewards in `group`, in order.
async fn accept_rewards(statements: &mut Statements<'_>, group: &mut [Job]) -> Result<(), StoreError> {
    let rewards = rewards(group);
    if !rewards.is_empty() {
        let answers = trials::accept_all(statements, &rewards).await?;
        answer_rewards(group, answers);
    }
    Ok(())
}

fn answer_rewards(group: &mut [Job], answers: Vec<RewardAnswer>) {
    let asked = group.iter_mut().filter_map(|job| match job {
        Job::Reward(asked) => Some(asked),
        _ => None,
    });
    for (asked, answer) in asked.zip(answers) {
        asked.answer = Some(answer);
    }
}
