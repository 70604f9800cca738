//! `etude openapi`.

use std::io::Write;

use super::CliError;
use crate::http;

pub(super) fn run(out: &mut impl Write) -> Result<(), CliError> {
    out.write_all(http::openapi().as_bytes())?;
    Ok(())
}
