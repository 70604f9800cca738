//! What a body is declared to be: JSON, NDJSON, or the file of another tool.

use axum::extract::{Query, Request};
use axum::http::HeaderMap;
use axum::http::header::CONTENT_TYPE;

use crate::service::ModelForm;
use etude_core::document::{Faults, Path};
use etude_core::model::{Edits, Format, ImportFormat};

/// The declared type of the body, without its parameters.
pub(super) fn essence(headers: &HeaderMap) -> &str {
    let declared = headers.get(CONTENT_TYPE).and_then(|declared| declared.to_str().ok()).unwrap_or_default();
    declared.split(';').next().unwrap_or_default().trim()
}

/// How the body is declared: as `application/json`, as another type that is written in JSON, or as NDJSON.
pub(super) fn format_of(headers: &HeaderMap) -> Option<Format> {
    let essence = essence(headers);
    // As most declare it.
    if essence == "application/json" {
        return Some(Format::Json);
    }
    let essence = essence.to_ascii_lowercase();
    match essence.strip_prefix("application/")? {
        "json" => Some(Format::Json),
        "x-ndjson" | "ndjson" | "jsonl" => Some(Format::Ndjson),
        subtype => subtype.ends_with("+json").then_some(Format::Json),
    }
}

/// What the body of a model is declared to be, with what the query says is to be changed on the way. `None` if that is nothing known.
pub(super) fn form_of(request: &Request) -> Option<Result<ModelForm, Faults>> {
    let headers = request.headers();
    let imported =
        ImportFormat::ALL.into_iter().find(|format| essence(headers).eq_ignore_ascii_case(format.media_type()));
    let mut faults = Faults::default();
    let mut edits = Edits::default();
    let query = Query::<Vec<(String, String)>>::try_from_uri(request.uri());
    for (name, value) in query.map(|Query(query)| query).unwrap_or_default() {
        let added = match (&*name, imported) {
            ("without", Some(_)) => {
                edits.without.push(value);
                Ok(())
            }
            ("rename", Some(_)) => edits.add_rename(&value),
            ("cost", Some(_)) => edits.add_cost(&value),
            ("unsafe", Some(_)) => {
                edits.unsafe_if.push(value);
                Ok(())
            }
            (_, Some(_)) => Err("unknown query parameter; known here: without, rename, cost, unsafe".to_owned()),
            ("without" | "rename" | "cost" | "unsafe", None) => {
                Err("is for what is imported from other formats".to_owned())
            }
            (_, None) => Ok(()),
        };
        if let Err(detail) = added {
            faults.note_at(&Path::Member(&Path::Root, &name), detail);
        }
    }
    let form = match imported {
        Some(format) => ModelForm::Imported(format, Box::new(edits)),
        None => ModelForm::Own(format_of(headers)?),
    };
    Some(faults.check(Some(form)))
}
