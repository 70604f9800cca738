//! What the rules of a cave change, attribute by attribute, whatever can be reached.

use super::ActionIdx;
use super::wumpus::{Act, Cave, Heading, position};

/// A way to change the values of some attributes. Values are indices into the domains.
///
/// The operators of a cave allow all that its rules do, and more: every transition has an operator of its action that
/// changes the same attributes from and to the same values, and that keeps nothing but what the transition keeps.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Operator {
    pub(crate) action: ActionIdx,
    /// Positions of attributes, and the values that they must have and keep.
    pub(crate) kept: Vec<(usize, u32)>,
    /// Positions of attributes, and the values from and to which they change. Not empty.
    pub(crate) changed: Vec<(usize, u32, u32)>,
}

impl Cave {
    /// Every operator of the body: about four times as many as there are cells.
    pub(crate) fn operators(&self) -> impl Iterator<Item = Operator> + '_ {
        let actions = (0..).zip(self.actions()).filter_map(|(index, action)| Some((index, Act::named(&action.name)?)));
        actions.flat_map(|(action, act)| {
            self.operators_of(act).map(move |(mut kept, changed)| {
                // Outside, nothing has an effect.
                if act != Act::Climb {
                    kept.push((position::OUTSIDE, 0));
                }
                Operator { action, kept, changed }
            })
        })
    }

    fn operators_of(&self, act: Act) -> Box<dyn Iterator<Item = Effect> + '_> {
        match act {
            Act::Forward => Box::new(self.moves()),
            Act::TurnLeft => Box::new(turns(1)),
            Act::TurnRight => Box::new(turns(3)),
            Act::Shoot => Box::new(self.shots()),
            Act::Grab => Box::new(self.grabs()),
            Act::Climb => {
                let (x, y) = self.first_state().cell;
                let kept = vec![(position::X, x.into()), (position::Y, y.into())];
                Box::new(std::iter::once((kept, vec![(position::OUTSIDE, 0, 1)])))
            }
        }
    }

    /// From each cell, in each direction; into a cell of wumpi only while they are dead.
    fn moves(&self) -> impl Iterator<Item = Effect> + '_ {
        let (width, height) = self.size();
        let cells = (0..height).flat_map(move |y| (0..width).map(move |x| (x, y)));
        let poses = cells.flat_map(|cell| Heading::ALL.map(|heading| (cell, heading)));
        poses.filter_map(|(cell, heading)| {
            let to = self.ahead(cell, heading).filter(|to| !self.is_pit(*to))?;
            let [x, y] = [(position::X, cell.0, to.0), (position::Y, cell.1, to.1)];
            let ((at, from, to_value), (other, value, _)) = if cell.0 == to.0 { (y, x) } else { (x, y) };
            let mut kept = vec![(other, value.into()), (position::HEADING, heading as u32)];
            let wumpi = self.wumpi().iter().zip(self.wumpus_positions());
            kept.extend(wumpi.filter(|(wumpus, _)| **wumpus == to).map(|(_, at)| (at, 0)));
            Some((kept, vec![(at, from.into(), to_value.into())]))
        })
    }

    /// An arrow less, and any wumpus less or none.
    fn shots(&self) -> impl Iterator<Item = Effect> + '_ {
        (1..=u32::from(self.first_state().arrows)).flat_map(|n| {
            let arrows = (position::ARROWS, n, n - 1);
            let hits = self.wumpus_positions().map(move |wumpus| vec![arrows, (wumpus, 1, 0)]);
            std::iter::once(vec![arrows]).chain(hits).map(|changed| (Vec::new(), changed))
        })
    }

    /// Any piece of gold, as one of any number.
    fn grabs(&self) -> impl Iterator<Item = Effect> + '_ {
        let pieces = self.gold().iter().zip(self.gold_positions());
        pieces.flat_map(|(cell, piece)| {
            (0u32..).take(self.gold().len()).map(move |n| {
                let kept = vec![(position::X, cell.0.into()), (position::Y, cell.1.into())];
                (kept, vec![(position::GOLD, n, n + 1), (piece, 1, 0)])
            })
        })
    }
}

/// What an operator keeps, and what it changes.
type Effect = (Vec<(usize, u32)>, Vec<(usize, u32, u32)>);

fn turns(quarters: u32) -> impl Iterator<Item = Effect> {
    (0..4).map(move |heading| (Vec::new(), vec![(position::HEADING, heading, (heading + quarters) % 4)]))
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::interrupt::Uninterrupted;
    use crate::model::{Definition, Limits, Model};

    #[test]
    fn every_transition_has_an_operator() {
        let definition = json!({"dynamics": {
            "kind": "wumpus", "width": 4, "height": 3, "pits": [[3, 2]], "wumpi": [[2, 0], [2, 0], [0, 2]],
            "gold": [[1, 0], [1, 0], [2, 0]], "start": {"x": 1, "y": 1, "heading": "north"}, "arrows": 3,
        }});
        let definition = Definition::read(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let model = Model::compile(&definition, Limits::DEFAULT, &mut Uninterrupted).unwrap();
        let Definition::Wumpus(cave) = definition else { panic!("a cave") };
        let operators: Vec<Operator> = cave.operators().collect();
        let mut is_used = vec![false; operators.len()];
        for (from, transition) in model.graph().iter() {
            let (row, row_after) = (model.states().row(from), model.states().row(transition.to));
            let differences = (0..row.len()).filter(|at| row[*at] != row_after[*at]);
            let changed: Vec<_> = differences.map(|at| (at, row[at], row_after[at])).collect();
            let found = operators.iter().position(|operator| {
                let is_kept = |(at, value): &(usize, u32)| row[*at] == *value && row_after[*at] == *value;
                operator.action == transition.action && operator.changed == changed && operator.kept.iter().all(is_kept)
            });
            let found = found.unwrap_or_else(|| panic!("{} changes {changed:?}", model.action(transition.action).name));
            is_used[found] = true;
        }
        let idle = operators.iter().zip(is_used).filter(|(_, is_used)| !is_used).count();
        assert!(idle < operators.len() / 4, "{idle} of {} allow what never happens", operators.len());
    }
}
