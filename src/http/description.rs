//! The OpenAPI description, as it is published.
//!
//! Handlers and types describe themselves. What none of them can say is added here:
//!
//! - the problems that any request may meet;
//! - that an object of a request has no members but those described, and that `null` is the same as a member left out; and that in an
//!   answer, a member that may be `null` is always there, unless it has a default;
//! - types that are told apart by a member, such as `kind`, as a schema each, with that member as discriminator: what generators of clients
//!   build a class from. Likewise one object where a type is made of several;
//! - an example for each operation, and the order in which operations are listed, in which each example works after those before it.

use std::collections::BTreeSet;
use std::collections::btree_map::Entry;

use utoipa::openapi::path::Operation;
use utoipa::openapi::{Content, OpenApi, Ref, RefOr, ResponseBuilder};
use yaml_serde::{Mapping, Value};

use super::examples;

/// Where schemas are that are referred to.
const SCHEMAS: &str = "#/components/schemas/";

/// Why no error is expected of what `yaml_serde` is given here.
const WRITABLE: &str = "every description can be written as YAML";

/// The text of a description that handlers and types have given.
///
/// # Panics
///
/// Never: every description can be written as YAML.
pub(super) fn published(mut description: OpenApi) -> String {
    add_problems(&mut description);
    let mut document = yaml_serde::to_value(&description).expect(WRITABLE);
    let schemas = document["components"]["schemas"].clone();
    merge_parts(&mut document, &schemas);
    if let Some(schemas) = document["components"]["schemas"].as_mapping_mut() {
        name_items(schemas);
        name_variants(schemas);
    }
    tell_members(&mut document);
    for path in mappings(&mut document["paths"]) {
        // One is read after it was written, and deleted last.
        let mut methods: Vec<_> = std::mem::take(path).into_iter().collect();
        methods.sort_by_key(|(method, _)| ["put", "post", "get", "delete"].iter().position(|known| method == known));
        *path = methods.into_iter().collect();
        path.values_mut().for_each(examples::add);
    }
    yaml_serde::to_string(&document).expect(WRITABLE)
}

/// The members of `value` that are objects.
fn mappings(value: &mut Value) -> impl Iterator<Item = &mut Mapping> {
    value.as_mapping_mut().into_iter().flat_map(Mapping::values_mut).filter_map(Value::as_mapping_mut)
}

/// Describes the problems that any request may meet, which are not the handlers' to name.
fn add_problems(description: &mut OpenApi) {
    const ANYWHERE: [(&str, &str); 4] = [
        ("400", "`bad-host`: not one `Host` header, or one that names no host"),
        ("403", "`foreign-origin`: the request comes from a web page that may not do this"),
        ("421", "`unknown-host`: the service is not known by the host that is asked for"),
        ("503", "`busy`: see `Retry-After`"),
    ];
    /// Nor a defect or a failing disk, which those for operators do not.
    const IN_CONTRACT: (&str, &str) = ("500", "`internal`: what went wrong was logged under the request's id");
    /// Nor this one, which any write may meet.
    const WRITING: (&str, &str) =
        ("507", "`storage-full`: no room is left for the database; what is there can be read");
    for (name, path) in &mut description.paths.paths {
        let in_contract = name.starts_with("/v1/").then_some(IN_CONTRACT);
        for operation in [&mut path.get, &mut path.put, &mut path.post, &mut path.delete].into_iter().flatten() {
            ANYWHERE
                .into_iter()
                .chain(in_contract)
                .for_each(|(status, meaning)| add_problem(operation, status, meaning));
        }
        for operation in [&mut path.put, &mut path.post, &mut path.delete].into_iter().flatten() {
            add_problem(operation, WRITING.0, WRITING.1);
        }
    }
}

/// Describes a problem of an operation that has others of this status, or none.
fn add_problem(operation: &mut Operation, status: &str, meaning: &str) {
    match operation.responses.responses.entry(status.to_owned()) {
        Entry::Vacant(vacant) => {
            let problem = Content::new(Some(Ref::from_schema_name("Problem")));
            let response = ResponseBuilder::new().description(meaning).content("application/problem+json", problem);
            vacant.insert(response.build().into());
        }
        Entry::Occupied(mut named) => {
            let (kind, _) = meaning.split_once(':').unwrap_or((meaning, ""));
            if let RefOr::T(response) = named.get_mut()
                && !response.description.contains(kind)
            {
                response.description = format!("{kind}, {}", response.description);
            }
        }
    }
}

/// Makes one object of what all parts of an `allOf` say, anywhere in `value`.
fn merge_parts(value: &mut Value, schemas: &Value) {
    match value {
        Value::Sequence(items) => items.iter_mut().for_each(|item| merge_parts(item, schemas)),
        Value::Mapping(members) => {
            members.values_mut().for_each(|member| merge_parts(member, schemas));
            let Some(Value::Sequence(parts)) = members.shift_remove("allOf") else { return };
            let mut properties = Vec::new();
            let mut required = Vec::new();
            for mut part in parts {
                if let Some(name) = reference(&part) {
                    part = schemas[name].clone();
                    merge_parts(&mut part, schemas);
                }
                for (name, told) in part.as_mapping_mut().map(std::mem::take).into_iter().flatten() {
                    match (name.as_str(), told) {
                        (Some("properties"), Value::Mapping(more)) => properties.extend(more),
                        (Some("required"), Value::Sequence(more)) => required.extend(more),
                        (_, told) => drop(members.entry(name).or_insert(told)),
                    }
                }
            }
            properties.sort_by(|(name, _), (other, _)| name.as_str().cmp(&other.as_str()));
            members.insert("required".into(), Value::Sequence(required));
            members.insert("properties".into(), Value::Mapping(properties.into_iter().collect()));
        }
        _ => {}
    }
}

/// The name of the schema that `schema` refers to.
fn reference(schema: &Value) -> Option<&str> {
    schema.get("$ref")?.as_str()?.strip_prefix(SCHEMAS)
}

/// Refers to the items of lists by name, which stand within their lists.
fn name_items(schemas: &mut Mapping) {
    for (name, list) in schemas {
        if let Some(item) = name.as_str().and_then(|name| name.strip_prefix("List_")) {
            let reference = Mapping::from_iter([("$ref".into(), format!("{SCHEMAS}{item}").into())]);
            list["properties"]["items"]["items"] = Value::Mapping(reference);
        }
    }
}

/// Gives each variant of a schema that a member tells apart a schema of its own, called by its title.
fn name_variants(schemas: &mut Mapping) {
    let mut named = Vec::new();
    for schema in schemas.values_mut() {
        let Some(Value::Sequence(variants)) = schema.get_mut("oneOf") else { continue };
        let Some(told_apart) = variants.iter().map(tag).collect::<Option<Vec<_>>>() else { continue };
        let Some((property, _, _)) = told_apart.first().cloned() else { continue };
        let mut mapping = Mapping::new();
        for (variant, (_, value, title)) in variants.iter_mut().zip(told_apart) {
            let path = format!("{SCHEMAS}{title}");
            mapping.insert(value.into(), path.clone().into());
            let reference = Mapping::from_iter([("$ref".into(), path.into())]);
            named.push((title.into(), std::mem::replace(variant, Value::Mapping(reference))));
        }
        let discriminator = [("propertyName".into(), property.into()), ("mapping".into(), Value::Mapping(mapping))];
        schema["discriminator"] = Value::Mapping(discriminator.into_iter().collect());
    }
    for (title, mut schema) in named {
        if let Some(schema) = schema.as_mapping_mut() {
            schema.shift_remove("title");
        }
        schemas.insert(title, schema);
    }
    let mut sorted: Vec<_> = std::mem::take(schemas).into_iter().collect();
    sorted.sort_by(|(name, _), (other, _)| name.as_str().cmp(&other.as_str()));
    *schemas = sorted.into_iter().collect();
}

/// What tells a variant apart: the member with its only value, and the title.
fn tag(variant: &Value) -> Option<(String, String, String)> {
    let title = variant.get("title")?.as_str()?;
    let told_apart = |(property, schema): (&Value, &Value)| match schema.get("enum")?.as_sequence()?.as_slice() {
        [only] => Some((property.as_str()?.to_owned(), only.as_str()?.to_owned(), title.to_owned())),
        _ => None,
    };
    variant.get("properties")?.as_mapping()?.iter().find_map(told_apart)
}

/// Says which members objects have: those of requests no others than described, which may be `null` where they may be left out; those of
/// answers always those that may be `null`, unless they have a default.
fn tell_members(document: &mut Value) {
    /// What a client sends beside bodies.
    const FRAMES: &str = "ClientFrame";
    let mut ahead = vec![FRAMES.to_owned()];
    for operation in mappings(&mut document["paths"]).flat_map(Mapping::values_mut) {
        let contents = operation.get_mut("requestBody").and_then(|body| body.get_mut("content"));
        for content in contents.into_iter().flat_map(mappings) {
            content.get_mut("schema").into_iter().for_each(|schema| close(schema, &mut ahead));
        }
    }
    let mut closed = BTreeSet::new();
    let Some(schemas) = document["components"]["schemas"].as_mapping_mut() else { return };
    while let Some(name) = ahead.pop() {
        if let Some(schema) = schemas.get_mut(&*name)
            && closed.insert(name)
        {
            close(schema, &mut ahead);
        }
    }
    for (name, schema) in schemas {
        if name.as_str().is_some_and(|name| !closed.contains(name)) {
            require_nullable(schema);
        }
    }
}

/// Closes the objects of a schema, and notes the schemas that it refers to.
fn close(schema: &mut Value, ahead: &mut Vec<String>) {
    ahead.extend(reference(schema).map(ToOwned::to_owned));
    for several in ["oneOf", "anyOf", "prefixItems"] {
        let several = schema.get_mut(several).and_then(Value::as_sequence_mut);
        several.into_iter().flatten().for_each(|schema| close(schema, ahead));
    }
    for one in ["items", "additionalProperties"] {
        schema.get_mut(one).into_iter().for_each(|schema| close(schema, ahead));
    }
    let Some(object) = schema.as_mapping_mut().filter(|object| object.contains_key("properties")) else { return };
    object.entry("additionalProperties".into()).or_insert(false.into());
    let required = object.get("required").and_then(Value::as_sequence).cloned().unwrap_or_default();
    for (name, member) in object.get_mut("properties").and_then(Value::as_mapping_mut).into_iter().flatten() {
        close(member, ahead);
        if !required.contains(name) {
            allow_null(member);
        }
    }
}

/// Requires the members that may be `null`.
fn require_nullable(schema: &mut Value) {
    let Some(object) = schema.as_mapping_mut() else { return };
    let mut nullable = Vec::new();
    for (name, member) in object.get("properties").and_then(Value::as_mapping).into_iter().flatten() {
        let types = member.get("type").and_then(Value::as_sequence).into_iter().flatten();
        let either = member.get("oneOf").and_then(Value::as_sequence).into_iter().flatten();
        let is_nullable = types.chain(either.filter_map(|schema| schema.get("type"))).any(|kind| kind == "null");
        if is_nullable && member.get("default").is_none() {
            nullable.push(name.clone());
        }
    }
    if !nullable.is_empty() {
        let required = object.entry("required".into()).or_insert_with(|| Value::Sequence(Vec::new()));
        if let Some(required) = required.as_sequence_mut() {
            nullable.retain(|name| !required.contains(name));
            required.append(&mut nullable);
        }
    }
}

/// Lets a schema have the value `null`, too.
fn allow_null(schema: &mut Value) {
    fn add(list: &mut Vec<Value>, null: Value) {
        if !list.contains(&null) {
            list.push(null);
        }
    }
    let null = || Value::Mapping(Mapping::from_iter([("type".into(), "null".into())]));
    let is_reference = reference(schema).is_some();
    match (schema.get_mut("type"), is_reference) {
        (Some(Value::Sequence(types)), _) => add(types, "null".into()),
        (Some(only), _) => *only = Value::Sequence(vec![only.clone(), "null".into()]),
        (None, true) => {
            let reference = std::mem::take(schema);
            let either = Value::Sequence(vec![reference, null()]);
            *schema = Value::Mapping(Mapping::from_iter([("oneOf".into(), either)]));
        }
        (None, false) => {
            for any in ["oneOf", "anyOf"] {
                if let Some(any) = schema.get_mut(any).and_then(Value::as_sequence_mut) {
                    add(any, null());
                }
            }
        }
    }
    if let Some(Value::Sequence(values)) = schema.get_mut("enum") {
        add(values, Value::Null);
    }
}
