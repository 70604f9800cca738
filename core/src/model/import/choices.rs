//! What models of verification tools have in common: states with choices, each perhaps with a label, and rewards, of which one is the cost.

use std::collections::HashMap;

use super::draft::{Draft, DraftAttribute, Way, cost_of};
use super::{Edits, ImportError, Spot};
use crate::attribute::Attribute;
use crate::document::list_known;
use crate::model::ActionIdx;
use crate::model::reading::Raw;

/// Labels of states that say what is known otherwise: where the body starts, and that nothing leaves a state.
const WITHOUT_NEWS: [&str; 2] = ["init", "deadlock"];

/// The choices of a model, as they are read.
pub(super) struct Choices {
    pub(super) draft: Draft,
    /// The action of each label.
    actions: HashMap<String, ActionIdx>,
    /// Actions of the state in hand.
    taken: Vec<ActionIdx>,
    /// How many of its choices have no label.
    n_unlabelled: usize,
    /// What is said of every action if it is not known which of several rewards is the cost.
    undecided: Option<(Spot, String)>,
    /// Whether rewards above and below 0 were met.
    signs: [bool; 2],
}

impl Choices {
    pub(super) fn new(draft: Draft) -> Self {
        Self { draft, actions: HashMap::new(), taken: Vec::new(), n_unlabelled: 0, undecided: None, signs: [false; 2] }
    }

    /// Which of the rewards called so is the cost; `None` if there are none, or it is not known which.
    pub(super) fn choose_cost<N: AsRef<str>>(
        &mut self,
        names: &[N],
        edits: &Edits,
        spot: Spot,
    ) -> Result<Option<usize>, ImportError> {
        if let Some(wanted) = &edits.cost_reward {
            let position = names.iter().position(|name| name.as_ref() == wanted);
            let known = || if names.is_empty() { "none".to_owned() } else { list_known(names) };
            let detail =
                || ImportError::Unfit(format!("cost: no reward is called \"{wanted}\"; there are {}", known()));
            return position.map(Some).ok_or_else(detail);
        }
        if names.len() > 1 {
            let known = list_known(names);
            self.undecided =
                Some((spot, format!("there are several rewards, {known}, of which none is named by `cost`")));
        }
        Ok((names.len() == 1).then_some(0))
    }

    /// Begins the choices of another state.
    pub(super) fn begin_state(&mut self) {
        self.taken.clear();
        self.n_unlabelled = 0;
    }

    /// The action of the next choice of the state in hand: called as its label, or, of those that have none, as their position among these. Of
    /// several with the same label, the later ones are numbered.
    pub(super) fn action(&mut self, label: Option<&str>, spot: Spot) -> Result<ActionIdx, ImportError> {
        let name = label.map_or_else(|| self.n_unlabelled.to_string(), str::to_owned);
        self.n_unlabelled += usize::from(label.is_none());
        let mut action = self.named(name.clone(), spot)?;
        let mut n = 1;
        while self.taken.contains(&action) {
            n += 1;
            action = self.named(format!("{name} ({n})"), spot)?;
        }
        self.taken.push(action);
        Ok(action)
    }

    fn named(&mut self, name: String, spot: Spot) -> Result<ActionIdx, ImportError> {
        if let Some(action) = self.actions.get(&name) {
            return Ok(*action);
        }
        let action = self.draft.push_action(name.clone(), spot)?;
        if let Some((spot, detail)) = &self.undecided {
            self.draft.refuse(action, *spot, || detail.clone());
        }
        self.actions.insert(name, action);
        Ok(action)
    }

    /// Adds an outcome of a choice. A reward is a cost whatever its sign, as long as all have the same.
    pub(super) fn push_way(
        &mut self,
        action: ActionIdx,
        (to, probability): (u64, f64),
        reward: Option<f64>,
        spot: Spot,
    ) -> Result<(), ImportError> {
        let cost = reward.map(f64::abs).and_then(cost_of);
        if let Some(reward) = reward {
            self.signs[0] |= reward > 0.0;
            self.signs[1] |= reward < 0.0;
            if self.signs == [true; 2] {
                self.draft.refuse(action, spot, || {
                    format!("a reward of {reward}, where others are of the other sign: they are no costs")
                });
            } else if cost.is_none() {
                self.draft.refuse(action, spot, || format!("a reward of {reward} is no cost"));
            }
        }
        self.draft.push_way(Way { to, probability, cost }, spot)
    }

    /// Where states have no values: their number, and their labels, are their attributes.
    pub(super) fn label_states(&mut self, n_states: u64, labels: &Labels) -> Result<(), ImportError> {
        let telling: Vec<_> =
            labels.by_name.iter().filter(|(name, _)| !WITHOUT_NEWS.contains(&name.as_str())).collect();
        let named = telling.iter().map(|(name, _)| DraftAttribute::Named(name.clone()));
        let number = DraftAttribute::Whole(Attribute::category("state"));
        self.draft.set_attributes(std::iter::once(number).chain(named).collect());
        // States are noted in their order.
        let mut next = vec![0; telling.len()];
        for state in 0..n_states {
            let mut row = vec![Raw::Whole(state)];
            for ((_, states), next) in telling.iter().zip(&mut next) {
                let is_labelled = states.get(*next) == Some(&state);
                *next += usize::from(is_labelled);
                row.push(Raw::Boolean(is_labelled));
            }
            self.draft.push_row(row, Spot::Whole)?;
        }
        Ok(())
    }
}

/// Labels of states.
#[derive(Default)]
pub(super) struct Labels {
    /// In the order in which they were met, each with its states.
    by_name: Vec<(String, Vec<u64>)>,
}

impl Labels {
    /// Notes that `state` is labelled so, in the order of states. Whether the body starts there.
    pub(super) fn note(&mut self, name: &str, state: u64) -> bool {
        match self.by_name.iter_mut().find(|(known, _)| known == name) {
            Some((_, states)) if states.last() == Some(&state) => {}
            Some((_, states)) => states.push(state),
            None => self.by_name.push((name.to_owned(), vec![state])),
        }
        name == "init"
    }
}

/// Reads a value of a state: a number, `true` or `false`, or a word.
pub(super) fn value(text: &str) -> Raw<&str> {
    match text {
        "true" => Raw::Boolean(true),
        "false" => Raw::Boolean(false),
        _ => rational(text).map_or(Raw::Text(text), Raw::float),
    }
}

/// Reads a finite number, perhaps a fraction such as `1/3`.
pub(super) fn rational(text: &str) -> Option<f64> {
    let number = match text.split_once('/') {
        Some((over, under)) => over.trim().parse::<f64>().ok()? / under.trim().parse::<f64>().ok()?,
        None => text.trim().parse().ok()?,
    };
    Some(number).filter(|number| number.is_finite())
}
