//! What is changed on the way from a file to a model: a body that lacks actions, other names, other costs.

use super::ImportError;
use crate::attribute::MAX_COST;
use crate::document::{Quoted, list_known};

/// What is changed on the way from a file to a model. Names are those of the file; a pattern is a name in which `*` stands for any text and `?` for
/// any character.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Edits {
    /// Patterns of actions that the body lacks.
    pub without: Vec<String>,
    /// Old and new names of actions and attributes.
    pub rename: Vec<(String, String)>,
    /// What actions cost, by pattern, in place of what the file says; of several that fit an action, the last.
    pub costs: Vec<(String, f64)>,
    /// Which reward of the file is the cost, where there are several.
    pub cost_reward: Option<String>,
    /// States that must never be entered: expressions of CEL over the attributes of the model, one of which holds there.
    pub unsafe_if: Vec<String>,
}

impl Edits {
    /// Adds what is written as `OLD=NEW`.
    ///
    /// # Errors
    ///
    /// What would be right.
    pub fn add_rename(&mut self, written: &str) -> Result<(), String> {
        let (old, new) = written.split_once('=').ok_or("expected OLD=NEW")?;
        self.rename.push((old.to_owned(), new.to_owned()));
        Ok(())
    }

    /// Adds what is written as `ACTION=COST`, where `ACTION` may be a pattern, or is the name of a reward, which is the cost.
    ///
    /// # Errors
    ///
    /// What would be right.
    pub fn add_cost(&mut self, written: &str) -> Result<(), String> {
        let Some((pattern, cost)) = written.rsplit_once('=') else {
            self.cost_reward = Some(written.to_owned());
            return Ok(());
        };
        let is_cost = |cost: &f64| (0.0..=MAX_COST).contains(cost);
        let cost =
            cost.trim().parse().ok().filter(is_cost).ok_or("expected ACTION=COST, with a cost from 0 to 1e150")?;
        self.costs.push((pattern.to_owned(), cost));
        Ok(())
    }

    /// Whether the body lacks the action called `name`.
    pub(super) fn lacks(&self, name: &str) -> bool {
        self.without.iter().any(|pattern| fits(pattern, name))
    }

    /// What the action called `name` costs, whatever the file says.
    pub(super) fn cost(&self, name: &str) -> Option<f64> {
        self.costs.iter().rev().find(|(pattern, _)| fits(pattern, name)).map(|(_, cost)| *cost)
    }

    /// What is called `name` in the file, in the model.
    pub(super) fn renamed<'n>(&'n self, name: &'n str) -> &'n str {
        self.rename.iter().find(|(old, _)| old == name).map_or(name, |(_, new)| new)
    }

    /// Checks that each of them changes something.
    pub(super) fn check(&self, actions: &[&str], attributes: &[&str]) -> Result<(), ImportError> {
        let patterns = self.without.iter().map(|pattern| ("without", pattern));
        let patterns = patterns.chain(self.costs.iter().map(|(pattern, _)| ("cost", pattern)));
        for (option, pattern) in patterns {
            if !actions.iter().any(|name| fits(pattern, name)) {
                let detail = format!("{option}: no action is called like {}; there are", Quoted(pattern));
                return Err(ImportError::Unfit(format!("{detail} {}", list_known(actions))));
            }
        }
        for (old, _) in &self.rename {
            if !actions.contains(&old.as_str()) && !attributes.contains(&old.as_str()) {
                let detail = format!("rename: neither an action nor an attribute is called {}", Quoted(old));
                let (actions, attributes) = (list_known(actions), list_known(attributes));
                return Err(ImportError::Unfit(format!("{detail}; actions: {actions}; attributes: {attributes}")));
            }
        }
        Ok(())
    }
}

/// Whether `name` is what `pattern` stands for. `O(pattern * name)`.
fn fits(pattern: &str, name: &str) -> bool {
    let name: Vec<char> = name.chars().collect();
    // Whether the pattern up to here stands for so many characters.
    let mut reached = vec![false; name.len() + 1];
    reached[0] = true;
    for expected in pattern.chars() {
        if expected == '*' {
            let first = reached.iter().position(|is_reached| *is_reached).unwrap_or(reached.len());
            reached[first..].fill(true);
            continue;
        }
        for n in (1..reached.len()).rev() {
            reached[n] = reached[n - 1] && (expected == '?' || name[n - 1] == expected);
        }
        reached[0] = false;
    }
    reached[name.len()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_star_stands_for_any_text_and_a_question_mark_for_a_character() {
        for (pattern, name) in
            [("slide *", "slide a b"), ("*", ""), ("a*c*", "abcd"), ("m?ve", "move"), ("move", "move")]
        {
            assert!(fits(pattern, name), "{pattern} {name}");
        }
        for (pattern, name) in [("slide *", "slide"), ("?", ""), ("a*c", "abcd"), ("m?ve", "mve"), ("move", "remove")] {
            assert!(!fits(pattern, name), "{pattern} {name}");
        }
    }
}
