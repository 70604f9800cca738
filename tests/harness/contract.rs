//! What `openapi.yaml` promises, held against what tests send and are answered.
//!
//! A request that was accepted must be valid against the schemas of its operation; an answer must be of a status and a type that the
//! operation tells, and valid against their schema, where no object has a member that is not described.

use std::borrow::Cow;
use std::collections::HashMap;
use std::sync::{Arc, LazyLock, Mutex};

use jsonschema::Validator;
use reqwest::{Method, Url};
use serde_json::{Map, Value, json};

/// Larger bodies are not held against their schemas: in a build that is not optimized, that takes seconds.
pub(crate) const MAX_CHECKED_BYTES: usize = 256 << 10;

/// The contract of this build.
pub(crate) static CONTRACT: LazyLock<Contract> = LazyLock::new(Contract::published);

/// The description of the service, and what its schemas are compiled to.
pub(crate) struct Contract {
    pub(crate) document: Value,
    /// By the text of the schema.
    validators: Mutex<HashMap<String, Arc<Validator>>>,
}

/// A request, as far as it is held against the contract.
pub(crate) struct Sent {
    pub(crate) method: Method,
    pub(crate) url: Url,
    pub(crate) content_type: Option<String>,
    /// The body, where it is known and not compressed.
    pub(crate) body: Option<Vec<u8>>,
}

/// An answer, likewise.
pub(crate) struct Answered<'a> {
    pub(crate) status: u16,
    pub(crate) content_type: Option<&'a str>,
    /// The body, where it was read.
    pub(crate) body: Option<&'a [u8]>,
}

impl Contract {
    fn published() -> Self {
        let mut document: Value = yaml_serde::from_str(include_str!("../../openapi.yaml")).unwrap();
        close(&mut document["components"]["schemas"]);
        Self { document, validators: Mutex::default() }
    }

    /// Holds a request and its answer against the contract.
    ///
    /// # Panics
    ///
    /// If they break it.
    pub(crate) fn check(&self, sent: &Sent, answered: &Answered<'_>) {
        let Some((operation, values)) = self.operation(&sent.method, sent.url.path()) else { return };
        if let Some(broken) = self.broken_by_answer(operation, answered) {
            panic!("{} {} is answered with {}: {broken}", sent.method, sent.url.path(), answered.status);
        }
        if (200..300).contains(&answered.status)
            && let Some(broken) = self.broken_by_request(operation, &values, sent, answered)
        {
            panic!("{} {} is accepted with {}: {broken}", sent.method, sent.url, answered.status);
        }
    }

    /// What is wrong with a JSON document by one of the `components`; of one of several kinds, by what is said of its kind.
    pub(crate) fn broken_by(&self, schema: &str, document: &Value) -> Option<String> {
        let schema = &self.document["components"]["schemas"][schema];
        let discriminator = &schema["discriminator"];
        let kind = discriminator["propertyName"].as_str().and_then(|property| document.get(property)?.as_str());
        match kind.and_then(|kind| discriminator["mapping"].get(kind)?.as_str()) {
            Some(kind) => self.broken_by_schema(&json!({"$ref": kind}), document),
            None => self.broken_by_schema(schema, document),
        }
    }

    /// Holds a frame of the server against the contract.
    ///
    /// # Panics
    ///
    /// If it breaks it.
    pub(crate) fn check_frame(&self, frame: &Value) {
        let broken = self.broken_by("ServerFrame", frame);
        assert_eq!(broken, None, "{frame}");
    }

    /// The operation that a request means, and what its path's parameters are.
    pub(crate) fn operation<'c>(
        &'c self,
        method: &Method,
        path: &str,
    ) -> Option<(&'c Value, HashMap<&'c str, String>)> {
        let sent: Vec<_> = path.split('/').collect();
        self.document["paths"].as_object().unwrap().iter().find_map(|(template, item)| {
            let template: Vec<_> = template.split('/').collect();
            let mut values = HashMap::new();
            let mut is_alike = |template: &'c str, sent: &str| match template.strip_prefix('{') {
                Some(name) => {
                    values.insert(name.trim_end_matches('}'), sent.to_owned());
                    !sent.is_empty()
                }
                None => template == sent,
            };
            let is_meant = template.len() == sent.len() && template.iter().zip(&sent).all(|(t, s)| is_alike(t, s));
            let operation = item.get(method.as_str().to_lowercase()).filter(|_| is_meant)?;
            Some((operation, values))
        })
    }

    fn broken_by_answer(&self, operation: &Value, answered: &Answered<'_>) -> Option<String> {
        let Some(told) = operation["responses"].get(answered.status.to_string()) else {
            return Some("the operation tells no such status".to_owned());
        };
        let body = answered.body.filter(|body| !body.is_empty())?;
        let content_type = answered.content_type.map(essence);
        let Some(content) = content_type.and_then(|content_type| told["content"].get(content_type)) else {
            return Some(format!("the operation tells no {content_type:?}"));
        };
        if !content_type.is_some_and(is_json) {
            return None;
        }
        self.broken_by_schema(&content["schema"], &serde_json::from_slice(body).unwrap())
    }

    fn broken_by_request(
        &self,
        operation: &Value,
        values: &HashMap<&str, String>,
        sent: &Sent,
        answered: &Answered<'_>,
    ) -> Option<String> {
        let parameters = operation["parameters"].as_array().map(Vec::as_slice).unwrap_or_default();
        let named = |place: &str, name: &str| {
            parameters.iter().find(|parameter| parameter["in"] == place && parameter["name"] == name)
        };
        let in_path = values.iter().map(|(name, value)| ("path", Cow::Borrowed(*name), Cow::Borrowed(&**value)));
        let in_query = sent.url.query_pairs().map(|(name, value)| ("query", name, value));
        for (place, name, value) in in_path.chain(in_query) {
            let Some(parameter) = named(place, &name) else { return Some(format!("{name} is not described")) };
            // Where a number is meant, its text is one.
            let value = value.parse().map_or_else(|_| json!(value), |number: u64| json!(number));
            let schema = &parameter["schema"];
            // One of several.
            let schema = if schema["type"] == "array" { &schema["items"] } else { schema };
            let types = &schema["type"];
            let is_text = *types == "string" || types.as_array().is_some_and(|types| types.contains(&json!("string")));
            let value = if is_text && !value.is_string() { json!(value.to_string()) } else { value };
            if let Some(broken) = self.broken_by_schema(schema, &value) {
                return Some(format!("{name}: {broken}"));
            }
        }
        let body = sent.body.as_ref().filter(|body| !body.is_empty() && body.len() <= MAX_CHECKED_BYTES)?;
        let content_type = sent.content_type.as_deref().map(essence)?;
        // Where none is described, none is read.
        let contents = operation.get("requestBody")?.get("content")?;
        let Some(content) = contents.get(content_type) else {
            return Some(format!("a body of type {content_type} is not described"));
        };
        if !is_json(content_type) {
            return None;
        }
        let text = std::str::from_utf8(body).unwrap().trim_start_matches('\u{feff}');
        let mut document: Value = serde_json::from_str(text).unwrap();
        // What was refused of a batch is no part of what was accepted.
        let answer: Value = answered.body.map_or(Value::Null, |body| serde_json::from_slice(body).unwrap());
        if let (Some(items), Some(became)) =
            (document.get_mut("items").and_then(Value::as_array_mut), answer["items"].as_array())
        {
            let mut became = became.iter();
            items.retain(|_| became.next().is_some_and(|item| item.get("problem").is_none()));
            if items.is_empty() {
                return None;
            }
        }
        self.broken_by_schema(&content["schema"], &document)
    }

    /// What is wrong with a JSON document, by a schema of this description.
    pub(crate) fn broken_by_schema(&self, schema: &Value, document: &Value) -> Option<String> {
        const MOST_CHARS: usize = 400;
        let validator = self.validator(schema);
        let faults = validator.iter_errors(document).map(|fault| {
            let detail: String = fault.to_string().chars().take(MOST_CHARS).collect();
            format!("{}: {detail} ({})", fault.instance_path(), fault.schema_path())
        });
        let faults: Vec<_> = faults.collect();
        (!faults.is_empty()).then(|| faults.join("\n"))
    }

    fn validator(&self, schema: &Value) -> Arc<Validator> {
        let compile = || {
            let mut root = schema.clone();
            root["components"] = self.document["components"].clone();
            let options = jsonschema::draft202012::options().should_validate_formats(true);
            Arc::new(options.build(&root).unwrap_or_else(|error| panic!("{schema}: {error}")))
        };
        // A test that fails while it holds the lock must not fail the others.
        let mut validators = self.validators.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        Arc::clone(validators.entry(schema.to_string()).or_insert_with(compile))
    }
}

/// Lets no object have members that are not described. Clients must bear them, but here each is a gap in the description.
fn close(schema: &mut Value) {
    if let Some(members) = schema.as_object_mut() {
        if members.contains_key("properties") && !members.contains_key("additionalProperties") {
            members.insert("additionalProperties".to_owned(), json!(false));
        }
        members.values_mut().for_each(close);
    } else if let Some(items) = schema.as_array_mut() {
        items.iter_mut().for_each(close);
    }
}

/// A media type without its parameters.
fn essence(content_type: &str) -> &str {
    match content_type.split(';').next().unwrap_or_default().trim() {
        // Its other names.
        "application/ndjson" | "application/jsonl" => "application/x-ndjson",
        essence => essence,
    }
}

fn is_json(content_type: &str) -> bool {
    content_type == "application/json" || content_type == "application/problem+json"
}

/// Every operation, with its method and path, in the order in which the page lists them: by their tags, and within each as they stand.
pub(crate) fn listed() -> Vec<(Method, String, Map<String, Value>)> {
    let document: yaml_serde::Value = yaml_serde::from_str(include_str!("../../openapi.yaml")).unwrap();
    let tags: Vec<_> = CONTRACT.document["tags"].as_array().unwrap().iter().map(|tag| &tag["name"]).collect();
    let mut operations = Vec::new();
    for (path, item) in document["paths"].as_mapping().unwrap() {
        let path = path.as_str().unwrap();
        for method in item.as_mapping().unwrap().keys() {
            let method = method.as_str().unwrap();
            let operation = CONTRACT.document["paths"][path][method].as_object().unwrap().clone();
            operations.push((method.to_uppercase().parse().unwrap(), path.to_owned(), operation));
        }
    }
    operations.sort_by_key(|(_, _, operation)| tags.iter().position(|tag| **tag == operation["tags"][0]));
    operations
}
