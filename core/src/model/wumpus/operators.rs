//! What the rules of a cave change, attribute by attribute.

use super::attributes::position;
use super::{Act, Cave, Heading};
use crate::model::Operator;

impl Cave {
    /// Every operator of the body: about four times as many as there are cells.
    pub(super) fn all_operators(&self) -> impl Iterator<Item = Operator> + '_ {
        (0..).zip(&self.acts).flat_map(|(action, act)| {
            let act = *act;
            self.operators_of(act).map(move |(mut kept, changed)| {
                // Outside, nothing has an effect.
                if act != Act::Climb {
                    kept.push((position::OUTSIDE, 0));
                }
                Operator { action, cost: None, kept, changed }
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
