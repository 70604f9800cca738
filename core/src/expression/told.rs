//! What is wrong with a text, and where, in plain words.

/// What the parser says of a mistake, in words of those who write expressions and not grammars.
pub(super) fn plainly(message: &str) -> String {
    let unexpected = |found: &str| match found {
        "<EOF>" => "the expression ends too early".to_owned(),
        found => format!("`{found}` is not expected here"),
    };
    let after = |before: &str| message.split_once(before).map(|(_, rest)| rest);
    let quoted = |rest: &str| rest.rsplit_once('\'').map_or_else(|| rest.to_owned(), |(quoted, _)| quoted.to_owned());
    if let Some(rest) = after("missing '") {
        return format!("`{}` is missing here", rest.split('\'').next().unwrap_or(rest));
    }
    if let Some(rest) = after("recognition error at: '") {
        return format!("`{}` cannot be read", quoted(rest));
    }
    if let Some(rest) = after(" input '") {
        return unexpected(&quoted(rest.split_once(" expecting").map_or(rest, |(found, _)| found)));
    }
    if message.starts_with("Incomplete") {
        return "a part is missing after this".to_owned();
    }
    message.to_owned()
}

/// Where in `text` the character at the byte `offset` stands, in words.
pub(super) fn place_in(text: &str, offset: u32) -> String {
    let before = text.char_indices().take_while(|(at, _)| *at < offset as usize).map(|(_, c)| c);
    let (line, column) =
        before.fold((1, 1), |(line, column), c| if c == '\n' { (line + 1, 1) } else { (line, column + 1) });
    if text.contains('\n') { place_of(line, column) } else { format!("column {column}") }
}

/// A place, in words.
pub(super) fn place_of(line: isize, column: isize) -> String {
    if line > 1 { format!("line {line}, column {column}") } else { format!("column {column}") }
}
