//! What rules change, attribute by attribute, whatever can be reached.
//!
//! A rule is tried with all values of the attributes that it reads and changes. Where these are too many at once, each attribute that it
//! changes is taken by itself, with what its expression reads; and where that is too much as well, nothing is told of the attribute. What a
//! condition reads besides is not known then: it is null, which decides nothing, so that all is allowed that may be.

use std::collections::BTreeSet;

use super::{Placed, Rule, Rules};
use crate::expression::Datum;
use crate::model::{ActionIdx, Operator};

/// About how many values of attributes are tried of a rule at most.
const MAX_TRIED: u64 = 1 << 18;
/// About how many nodes are evaluated for a rule at most: a tenth of a second.
const MAX_WORK: u64 = 1 << 24;
/// About how many values are tried of all rules together at most.
const MAX_TRIED_IN_ALL: u64 = 1 << 21;

/// How the operators of the rules are told.
#[derive(Debug)]
pub(super) struct Plans {
    /// By rule, those of an action after those of the action before.
    plans: Vec<Plan>,
    /// Whether all changes of an attribute are told. Shape `[n_attributes]`.
    pub(super) is_told: Vec<bool>,
}

/// How the operators of a rule are told.
#[derive(Debug)]
enum Plan {
    /// By all values of these attributes.
    Whole(Vec<usize>),
    /// Each attribute by itself: from and to which values it goes, all different, and what the rule costs at least.
    Apart { changes: Vec<(usize, Vec<(u32, u32)>)>, cost: Option<f64> },
}

/// All rows of some attributes, of which the others are not known.
struct Rows<'r> {
    rules: &'r Rules,
    attributes: &'r [usize],
    len: u64,
}

impl<'r> Rows<'r> {
    fn new(rules: &'r Rules, attributes: &'r [usize]) -> Self {
        Self { rules, attributes, len: rules.n_rows(attributes) }
    }

    /// The row with this number: indices by attribute; those of others are not used.
    fn row(&self, mut number: u64) -> Vec<u32> {
        let mut row = vec![0; self.rules.domains.len()];
        for at in self.attributes {
            let n_values = u64::from(self.rules.domains[*at].len());
            #[expect(clippy::cast_possible_truncation, reason = "less than the number of values")]
            {
                row[*at] = (number % n_values) as u32;
            }
            number /= n_values;
        }
        row
    }

    fn variables(&self, row: &[u32]) -> Vec<Datum<'r>> {
        let mut variables: Vec<Datum<'r>> = row.iter().map(|_| Datum::Null).collect();
        for at in self.attributes {
            variables[*at] = self.rules.domains[*at].datum(row[*at]);
        }
        variables
    }
}

impl Rules {
    /// Every operator of the body.
    pub(super) fn all_operators(&self) -> impl Iterator<Item = Operator> {
        self.operators_by(self.plans())
    }

    /// The same, by these plans.
    pub(super) fn operators_by<'r>(&'r self, plans: &'r Plans) -> impl Iterator<Item = Operator> + 'r {
        let rules = (0..).zip(&self.by_action).flat_map(|(action, rules): (ActionIdx, _)| {
            rules.iter().enumerate().map(move |(n, rule)| (action, n, rule))
        });
        rules.zip(&plans.plans).flat_map(|((action, n, rule), plan)| self.operators_of(action, n, rule, plan))
    }

    /// Whether the operators tell all changes of each attribute.
    pub(super) fn told(&self) -> &[bool] {
        &self.plans().is_told
    }

    fn plans(&self) -> &Plans {
        self.plans.get_or_init(|| {
            let n_rules = self.by_action.iter().map(Vec::len).sum::<usize>() as u64;
            self.plans_within(MAX_TRIED.min(MAX_TRIED_IN_ALL / n_rules.max(1)))
        })
    }

    /// Plans by which at most so many values are tried of a rule.
    pub(super) fn plans_within(&self, most: u64) -> Plans {
        let mut is_told = vec![true; self.domains.len()];
        let mut plans = Vec::new();
        for rules in &self.by_action {
            for (n, rule) in rules.iter().enumerate() {
                plans.push(self.plan(&rules[..n], rule, most, &mut is_told));
            }
        }
        Plans { plans, is_told }
    }

    fn n_rows(&self, attributes: &[usize]) -> u64 {
        attributes.iter().fold(1, |n, at| n.saturating_mul(self.domains[*at].len().into()))
    }

    fn plan(&self, earlier: &[Rule], rule: &Rule, most: u64, is_told: &mut [bool]) -> Plan {
        let work = |placed: &Placed| placed.expression.work();
        let thens = || rule.effects.iter().flat_map(|effect| &effect.then);
        let conditions = earlier.iter().chain([rule]).filter_map(|rule| rule.when.as_ref());
        let of_rule = conditions.chain(&rule.cost).chain(&self.deadly).chain(thens().map(|(_, placed)| placed));
        let most = most.min(MAX_WORK / of_rule.map(work).sum::<u64>().max(1));

        let read = rule.when.iter().chain(&rule.cost).chain(thens().map(|(_, placed)| placed));
        let mut whole: BTreeSet<usize> = read.flat_map(|placed| placed.expression.reads()).copied().collect();
        whole.extend(thens().map(|(at, _)| at));
        let whole: Vec<usize> = whole.into_iter().collect();
        if self.n_rows(&whole) <= most {
            return Plan::Whole(whole);
        }
        let mut changes: Vec<(usize, BTreeSet<(u32, u32)>)> = Vec::new();
        for effect in &rule.effects {
            for (at, placed) in &effect.then {
                let mut own: BTreeSet<usize> = placed.expression.reads().iter().copied().collect();
                own.insert(*at);
                let own: Vec<usize> = own.into_iter().collect();
                if self.n_rows(&own) > most {
                    is_told[*at] = false;
                    continue;
                }
                let rows = Rows::new(self, &own);
                let found = (0..rows.len).filter_map(|number| {
                    let row = rows.row(number);
                    let variables = rows.variables(&row);
                    let to = self.index_after(earlier, rule, *at, placed, &variables)?;
                    (to != row[*at]).then_some((row[*at], to))
                });
                let found: BTreeSet<(u32, u32)> = found.collect();
                match changes.iter_mut().find(|(known, _)| known == at) {
                    Some((_, known)) => known.extend(found),
                    None => changes.push((*at, found)),
                }
            }
        }
        let changes = changes.into_iter().filter(|(_, found)| !found.is_empty());
        let changes = changes.map(|(at, found)| (at, found.into_iter().collect())).collect();
        Plan::Apart { changes, cost: rule.cost.as_ref().map(|cost| self.least_cost(cost, most)) }
    }

    /// What an expression costs at least: 0 if that takes too long to tell.
    fn least_cost(&self, cost: &Placed, most: u64) -> f64 {
        let own = cost.expression.reads();
        if self.n_rows(own) > most {
            return 0.0;
        }
        let rows = Rows::new(self, own);
        let costs = (0..rows.len).filter_map(|number| cost.cost(&rows.variables(&rows.row(number))).ok());
        let least = costs.fold(f64::INFINITY, f64::min);
        // Where it never has a value, the rule never applies.
        if least.is_finite() { least } else { 0.0 }
    }

    /// Whether a rule may apply after earlier ones where attributes have these values, as far as they are known.
    fn may_apply(earlier: &[Rule], rule: &Rule, variables: &[Datum<'_>]) -> bool {
        let is = |rule: &Rule, flag: bool| match &rule.when {
            None => flag,
            Some(when) => matches!(when.evaluate(variables), Ok(Datum::Bool(found)) if found == flag),
        };
        !is(rule, false) && !earlier.iter().any(|earlier| is(earlier, true))
    }

    /// Where a value goes, if the rule may apply and all that it reads is known.
    fn index_after(
        &self,
        earlier: &[Rule],
        rule: &Rule,
        at: usize,
        placed: &Placed,
        variables: &[Datum<'_>],
    ) -> Option<u32> {
        if !Self::may_apply(earlier, rule, variables) {
            return None;
        }
        placed.index(variables, &self.domains[at], &self.schema.attributes()[at].name).ok()
    }

    fn operators_of<'r>(
        &'r self,
        action: ActionIdx,
        n: usize,
        rule: &'r Rule,
        plan: &'r Plan,
    ) -> Box<dyn Iterator<Item = Operator> + 'r> {
        let earlier = &self.by_action[usize::from(action)][..n];
        match plan {
            Plan::Whole(attributes) => {
                let rows = Rows::new(self, attributes);
                Box::new((0..rows.len).flat_map(move |number| self.operators_in(&rows, number, action, earlier, rule)))
            }
            Plan::Apart { changes, cost } => {
                let n_operators = changes.iter().map(|(_, found)| found.len()).max().unwrap_or(0);
                Box::new((0..n_operators).map(move |n| {
                    let changed = changes.iter().map(|(at, found)| {
                        let (from, to) = found[n % found.len()];
                        (*at, from, to)
                    });
                    Operator { action, cost: *cost, kept: Vec::new(), changed: changed.collect() }
                }))
            }
        }
    }

    /// The operators of a rule where the attributes that it reads have the values of this row.
    fn operators_in(
        &self,
        rows: &Rows<'_>,
        number: u64,
        action: ActionIdx,
        earlier: &[Rule],
        rule: &Rule,
    ) -> Vec<Operator> {
        let row = rows.row(number);
        let mut variables = rows.variables(&row);
        if !Self::may_apply(earlier, rule, &variables) {
            return Vec::new();
        }
        let cost = match rule.cost.as_ref().map(|placed| placed.cost(&variables)) {
            None => None,
            Some(Ok(cost)) => Some(cost),
            Some(Err(_)) => return Vec::new(),
        };
        let mut operators = Vec::with_capacity(rule.effects.len());
        for effect in &rule.effects {
            let index = |(at, placed): &(usize, Placed)| {
                let to = placed.index(&variables, &self.domains[*at], &self.schema.attributes()[*at].name).ok()?;
                Some((*at, row[*at], to))
            };
            let Some(changed) = effect.then.iter().map(index).collect::<Option<Vec<_>>>() else { return Vec::new() };
            let changed: Vec<_> = changed.into_iter().filter(|(_, from, to)| from != to).collect();
            if !changed.is_empty() {
                operators.push(Operator { action, cost, kept: Vec::new(), changed });
            }
        }
        let Some(deadly) = &self.deadly else { return operators };
        operators.retain(|operator| {
            for (at, _, to) in &operator.changed {
                variables[*at] = self.domains[*at].datum(*to);
            }
            let is_deadly = matches!(deadly.evaluate(&variables), Ok(Datum::Bool(true)));
            for (at, from, _) in &operator.changed {
                variables[*at] = self.domains[*at].datum(*from);
            }
            !is_deadly
        });
        operators
    }
}
