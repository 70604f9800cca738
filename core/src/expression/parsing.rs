//! From texts to expressions.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;
use std::thread;

use cel::common::ast::{ComprehensionExpr, Expr, IdedExpr, LiteralValue, SourceInfo, operators};
use cel::parser::Parser;

use super::Expression;
use super::checking::{Type, called, operated};
use super::datum::Datum;
use super::names::{function, known_functions, operation, sign};
use super::node::{Fold, Kind, Node, Operation};
use super::told::{place_in, place_of, plainly};
use crate::document::{Quoted, list_known, normal};

/// Longest text of an expression, in bytes.
const MAX_BYTES: usize = 4096;
/// Most brackets, and arguments of macros, within one another.
const MAX_NESTED: u16 = 24;
/// Deepest tree of nodes: sums of many terms are deep without brackets. It is evaluated on the stack of whoever asks.
const MAX_DEPTH: usize = 200;
/// What the parser takes of the stack for so many brackets, with room to spare: 5 MB where nothing is optimized.
const STACK_BYTES: usize = 16 << 20;
/// From so many constants on, one is looked up by its hash.
const MANY: usize = 8;

/// The names that expressions may use.
#[derive(Clone, Debug)]
pub(crate) struct Scope {
    /// The number and the type of each variable; `None`: any name is a variable, of any type, and is numbered as it is met.
    variables: Option<HashMap<String, (usize, Type)>>,
    constants: HashMap<String, Datum<'static>>,
    /// The items of long lists among the constants, by where these are in memory: they are looked up by many expressions.
    items: HashMap<usize, Arc<HashSet<Datum<'static>>>>,
}

impl Scope {
    /// These variables, numbered in their order, and constants. Hides no variable by a constant.
    pub(crate) fn declared(
        variables: impl IntoIterator<Item = (String, Type)>,
        constants: HashMap<String, Datum<'static>>,
    ) -> Self {
        let variables = variables.into_iter().enumerate();
        let variables = Some(variables.map(|(n, (name, kind))| (name, (n, kind))).collect());
        let long = constants.values().filter_map(|constant| match constant {
            Datum::List(list) if list.len() >= MANY => Some((list.as_ptr().addr(), items_of(list))),
            _ => None,
        });
        let items = long.collect();
        Self { variables, constants, items }
    }

    /// Any variables, of any type.
    pub(crate) fn open() -> Self {
        Self { variables: None, constants: HashMap::new(), items: HashMap::new() }
    }

    /// Whether an `int` may stand for a `double`.
    fn is_lenient(&self) -> bool {
        self.variables.is_none()
    }
}

/// Reads expressions that share `names` of variables, which grow in an [open](Scope::open) scope. Each gives all that is wrong with it:
/// where, and what.
///
/// They are parsed on a thread of their own, as the parser takes more of the stack than callers may have. `None` if there is no thread to
/// be had.
pub(crate) fn read_all(
    texts: &[&str],
    scope: &Scope,
    names: &mut Vec<String>,
) -> Option<Vec<Result<Expression, Vec<String>>>> {
    thread::scope(|threads| {
        let read = || texts.iter().map(|text| read(text, scope, names)).collect();
        let reader = thread::Builder::new().stack_size(STACK_BYTES).spawn_scoped(threads, read).ok()?;
        reader.join().ok()
    })
}

fn read(text: &str, scope: &Scope, names: &mut Vec<String>) -> Result<Expression, Vec<String>> {
    let flaw = |detail: String| vec![detail];
    if text.len() > MAX_BYTES {
        return Err(flaw(format!("expected at most {MAX_BYTES} bytes, found {}", text.len())));
    }
    let parsed = Parser::new().max_recursion_depth(MAX_NESTED).parse_with_source_info(text);
    let (tree, source) = parsed.map_err(|errors| {
        /// One mistake makes the parser stumble again and again.
        const MAX_TOLD: usize = 3;
        let told = errors.errors.into_iter().take(MAX_TOLD);
        let told = told.map(|error| {
            let detail = if error.msg.contains("Recursion limit") {
                format!("more than {MAX_NESTED} brackets within one another")
            } else {
                plainly(&error.msg)
            };
            format!("{}: {detail}", place_of(error.pos.0, error.pos.1))
        });
        told.collect::<Vec<_>>()
    })?;
    let mut lowering = Lowering { text, source: &source, scope, names, locals: Vec::new(), flaws: Vec::new() };
    let lowered = lowering.lower(&tree);
    let flaws = lowering.flaws;
    let Some((root, result)) = lowered.filter(|_| flaws.is_empty()) else { return Err(flaws) };
    if root.depth() > MAX_DEPTH {
        return Err(flaw(format!("it has more than {MAX_DEPTH} operators after one another")));
    }
    let mut reads = Vec::new();
    root.collect_reads(&mut reads);
    reads.sort_unstable();
    reads.dedup();
    Ok(Expression { text: text.into(), root, result, reads: reads.into() })
}

/// Makes nodes of the parser's tree.
struct Lowering<'s> {
    text: &'s str,
    source: &'s SourceInfo,
    scope: &'s Scope,
    names: &'s mut Vec<String>,
    /// Names and types of what macros go through, from the outermost to the innermost.
    locals: Vec<(String, Type)>,
    flaws: Vec<String>,
}

type Lowered = Option<(Node, Type)>;

impl Lowering<'_> {
    fn note(&mut self, offset: u32, detail: impl AsRef<str>) {
        self.flaws.push(format!("{}: {}", place_in(self.text, offset), detail.as_ref()));
    }

    fn refuse(&mut self, offset: u32, what: &str) -> Lowered {
        self.note(offset, format!("{what} are not supported here"));
        None
    }

    fn lower(&mut self, tree: &IdedExpr) -> Lowered {
        let offset = self.source.offset_for(tree.id).map_or(0, |(start, _)| start);
        match &tree.expr {
            Expr::Literal(literal) => self.lower_literal(offset, literal),
            Expr::Ident(name) => self.lower_name(offset, name),
            Expr::Select(select) if select.test => self.refuse(offset, "tests by has()"),
            Expr::Select(_) => match qualified_name(&tree.expr) {
                Some(name) => {
                    // It begins where its first part stands.
                    let first = first_part(tree);
                    let offset = self.source.offset_for(first.id).map_or(offset, |(start, _)| start);
                    self.lower_name(offset, &name)
                }
                None => self.refuse(offset, "members of values"),
            },
            Expr::List(list) => self.lower_list(offset, &list.elements),
            Expr::Comprehension(comprehension) => self.lower_fold(offset, comprehension),
            Expr::Call(call) => match (call.func_name.as_str(), &call.target) {
                (operators::CONDITIONAL, None) => self.lower_conditional(offset, &call.args),
                (operators::LOGICAL_AND | operators::LOGICAL_OR, None) => {
                    self.lower_connection(offset, call.func_name == operators::LOGICAL_AND, &call.args)
                }
                (operators::LOGICAL_NOT, None) => self.lower_not(offset, &call.args),
                (operators::NEGATE, None) => self.lower_negation(offset, &call.args),
                (name, None) if operation(name).is_some() => {
                    operation(name).and_then(|operation| self.lower_operation(offset, operation, &call.args))
                }
                (name, target) => self.lower_call(offset, name, target.as_deref(), &call.args),
            },
            Expr::Map(_) => self.refuse(offset, "maps"),
            Expr::Struct(_) => self.refuse(offset, "messages"),
            Expr::Unspecified => self.refuse(offset, "empty expressions"),
        }
    }

    fn lower_literal(&mut self, offset: u32, literal: &LiteralValue) -> Lowered {
        let constant = match literal {
            LiteralValue::Boolean(flag) => Datum::Bool(flag.into_inner()),
            LiteralValue::Double(number) => Datum::Double(number.into_inner()),
            LiteralValue::Int(number) => Datum::Int(number.into_inner()),
            LiteralValue::String(text) => Datum::text(&normal(text.inner())),
            LiteralValue::Null if self.scope.is_lenient() => Datum::Null,
            LiteralValue::Null => return self.refuse(offset, "nulls"),
            LiteralValue::UInt(_) => return self.refuse(offset, "unsigned numbers"),
            LiteralValue::Bytes(_) => return self.refuse(offset, "bytes"),
        };
        Some(constant_node(offset, constant))
    }

    fn lower_name(&mut self, offset: u32, name: &str) -> Lowered {
        if let Some(number) = self.locals.iter().rposition(|(local, _)| local == name) {
            return Some((Node { offset, kind: Kind::Local(number) }, self.locals[number].1.clone()));
        }
        let Some(variables) = &self.scope.variables else {
            let known = self.names.iter().position(|known| known == name);
            let number = known.unwrap_or_else(|| {
                self.names.push(name.to_owned());
                self.names.len() - 1
            });
            return Some((Node { offset, kind: Kind::Variable(number) }, Type::Any));
        };
        if let Some((number, kind)) = variables.get(name) {
            return Some((Node { offset, kind: Kind::Variable(*number) }, kind.clone()));
        }
        if let Some(constant) = self.scope.constants.get(name) {
            return Some(constant_node(offset, constant.clone()));
        }
        let mut known: Vec<&String> = variables.keys().chain(self.scope.constants.keys()).collect();
        known.sort_unstable();
        let detail = format!("unknown name {}; known here: {}", Quoted(name), list_known(known));
        self.note(offset, detail);
        None
    }

    fn lower_list(&mut self, offset: u32, items: &[IdedExpr]) -> Lowered {
        let items = self.lower_each(items)?;
        let kind = Type::list_of(items.iter().map(|(_, kind)| kind.clone()));
        let constant = |(node, _): &(Node, Type)| match &node.kind {
            Kind::Constant(constant) => Some(constant.clone()),
            _ => None,
        };
        if let Some(constants) = items.iter().map(constant).collect() {
            return Some((Node { offset, kind: Kind::Constant(Datum::list(constants)) }, kind));
        }
        let nodes = items.into_iter().map(|(node, _)| node).collect();
        Some((Node { offset, kind: Kind::List(nodes) }, kind))
    }

    /// All of them, with what is wrong with each.
    fn lower_each(&mut self, trees: &[IdedExpr]) -> Option<Vec<(Node, Type)>> {
        let lowered: Vec<Lowered> = trees.iter().map(|tree| self.lower(tree)).collect();
        lowered.into_iter().collect()
    }

    fn lower_some<const N: usize>(&mut self, trees: &[IdedExpr]) -> Option<[(Node, Type); N]> {
        self.lower_each(trees)?.try_into().ok()
    }

    /// Notes an operand that is not of the type that is wanted, unless it may be.
    fn expect(&mut self, (node, found): &(Node, Type), wanted: &Type) -> Option<()> {
        let is_fit = found == wanted || *found == Type::Any;
        if !is_fit {
            self.note(node.offset, format!("expected {wanted}, found {found}"));
        }
        is_fit.then_some(())
    }

    fn lower_conditional(&mut self, offset: u32, parts: &[IdedExpr]) -> Lowered {
        let [condition, a, b] = self.lower_some(parts)?;
        self.expect(&condition, &Type::Bool)?;
        let joined = a.1.clone().joined(b.1.clone());
        let joined = joined.or_else(|| self.scope.is_lenient().then_some(Type::Any));
        let Some(kind) = joined else {
            self.note(offset, format!("this gives {} or {}, and one type is needed", a.1, b.1));
            return None;
        };
        Some((Node { offset, kind: Kind::Conditional(Box::new([condition.0, a.0, b.0])) }, kind))
    }

    fn lower_connection(&mut self, offset: u32, is_and: bool, operands: &[IdedExpr]) -> Lowered {
        let [a, b] = self.lower_some(operands)?;
        let (is_a_fit, is_b_fit) = (self.expect(&a, &Type::Bool), self.expect(&b, &Type::Bool));
        is_a_fit.and(is_b_fit)?;
        let operands = Box::new([a.0, b.0]);
        Some((Node { offset, kind: if is_and { Kind::And(operands) } else { Kind::Or(operands) } }, Type::Bool))
    }

    fn lower_not(&mut self, offset: u32, operands: &[IdedExpr]) -> Lowered {
        let [operand] = self.lower_some(operands)?;
        self.expect(&operand, &Type::Bool)?;
        Some((Node { offset, kind: Kind::Not(Box::new(operand.0)) }, Type::Bool))
    }

    fn lower_negation(&mut self, offset: u32, operands: &[IdedExpr]) -> Lowered {
        let [(node, kind)] = self.lower_some(operands)?;
        if !matches!(kind, Type::Int | Type::Double | Type::Any) {
            self.note(offset, format!("expected int or double, found {kind}"));
            return None;
        }
        Some((Node { offset, kind: Kind::Negate(Box::new(node)) }, kind))
    }

    fn lower_operation(&mut self, offset: u32, operation: Operation, operands: &[IdedExpr]) -> Lowered {
        let [a, b] = self.lower_some(operands)?;
        let Some(kind) = operated(operation, &a.1, &b.1, self.scope.is_lenient()) else {
            let are_mixed = matches!((&a.1, &b.1), (Type::Int, Type::Double) | (Type::Double, Type::Int));
            let hint = if are_mixed { ": write double(..) or int(..) around one of them" } else { "" };
            self.note(offset, format!("{} cannot be applied to {} and {}{hint}", sign(operation), a.1, b.1));
            return None;
        };
        let node = match (operation, b.0.kind) {
            (Operation::In, Kind::Constant(Datum::List(list))) if list.len() >= MANY => {
                let known = self.scope.items.get(&list.as_ptr().addr()).cloned();
                Kind::OneOf(Box::new(a.0), known.unwrap_or_else(|| items_of(&list)))
            }
            (operation, b_kind) => Kind::Binary(operation, Box::new([a.0, Node { offset: b.0.offset, kind: b_kind }])),
        };
        Some((Node { offset, kind: node }, kind))
    }

    fn lower_call(&mut self, offset: u32, name: &str, target: Option<&IdedExpr>, arguments: &[IdedExpr]) -> Lowered {
        let is_math = target.is_some_and(|target| matches!(&target.expr, Expr::Ident(name) if name == "math"));
        let receiver = target.filter(|_| !is_math);
        let known = function(name).filter(|(_, of_math)| *of_math == is_math);
        let receiver = match receiver {
            Some(receiver) => Some(self.lower(receiver)?),
            None => None,
        };
        let mut lowered = self.lower_each(arguments)?;
        if let Some(receiver) = receiver {
            lowered.insert(0, receiver);
        }
        // A function is called where its bracket opens.
        let offset = offset.saturating_sub(u32::try_from(name.chars().count()).unwrap_or(0));
        let Some((function, _)) = known else {
            let prefix = if is_math { "math." } else { "" };
            self.note(offset, format!("unknown function {prefix}{name}(); known are {}", known_functions()));
            return None;
        };
        let types: Vec<Type> = lowered.iter().map(|(_, kind)| kind.clone()).collect();
        let Some(kind) = called(function, &types) else {
            let found: Vec<String> = types.iter().map(ToString::to_string).collect();
            self.note(offset, format!("{name}() cannot be applied to ({})", found.join(", ")));
            return None;
        };
        let nodes = lowered.into_iter().map(|(node, _)| node).collect();
        Some((Node { offset, kind: Kind::Call(function, nodes) }, kind))
    }

    fn lower_fold(&mut self, offset: u32, fold: &ComprehensionExpr) -> Lowered {
        if fold.iter_var2.is_some() {
            return self.refuse(offset, "macros of two variables");
        }
        let range = self.lower(&fold.iter_range)?;
        let Some(item) = range.1.clone().item() else {
            self.note(range.0.offset, format!("expected list, found {}", range.1));
            return None;
        };
        let (first, first_kind) = self.lower(&fold.accu_init)?;
        let n_locals = self.locals.len();
        self.locals.push((fold.iter_var.clone(), item));
        self.locals.push((fold.accu_var.clone(), first_kind.clone()));
        let step = self.lower(&fold.loop_step);
        // A list that is empty at first is one of what is put into it.
        let kind = step.as_ref().and_then(|(_, kind)| first_kind.joined(kind.clone())).unwrap_or(Type::Any);
        self.locals[n_locals + 1].1 = kind;
        let (go_on, result) = (self.lower(&fold.loop_cond), self.lower(&fold.result));
        self.locals.truncate(n_locals);
        let ((step, _), (go_on, _), (result, kind)) = (step?, go_on?, result?);
        Some((Node { offset, kind: Kind::Fold(Box::new(Fold { range: range.0, first, go_on, step, result })) }, kind))
    }
}

/// The items of a list, to be looked up.
fn items_of(list: &[Datum<'static>]) -> Arc<HashSet<Datum<'static>>> {
    Arc::new(list.iter().cloned().collect())
}

fn constant_node(offset: u32, constant: Datum<'static>) -> (Node, Type) {
    let kind = Type::of(&constant);
    (Node { offset, kind: Kind::Constant(constant) }, kind)
}

/// The name that a chain of selections spells, such as `arm.angle`.
fn qualified_name(expr: &Expr) -> Option<String> {
    match expr {
        Expr::Ident(name) => Some(name.clone()),
        Expr::Select(select) if !select.test => {
            Some(format!("{}.{}", qualified_name(&select.operand.expr)?, select.field))
        }
        _ => None,
    }
}

fn first_part(tree: &IdedExpr) -> &IdedExpr {
    match &tree.expr {
        Expr::Select(select) => first_part(&select.operand),
        _ => tree,
    }
}
