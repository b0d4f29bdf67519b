//! One TOML text with its name: parses into raw types and places every complaint at file and line.

use std::fmt::Display;
use std::ops::{Range, RangeInclusive};
use std::path::Path;

use serde::de::DeserializeOwned;
use thiserror::Error;
use toml::Spanned;

/// Why a file was refused.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file could not be read.
    #[error("{file}: cannot be read: {cause}")]
    Read {
        /// Path as given.
        file: String,
        /// What the system said.
        cause: std::io::Error,
    },
    /// The file could not be written.
    #[error("{file}: cannot be written: {cause}")]
    Write {
        /// Path as given.
        file: String,
        /// What the system said.
        cause: std::io::Error,
    },
    /// Not TOML, an unknown key, a missing key or a value of the wrong type.
    #[error("{file}: {detail}")]
    Syntax {
        /// Path as given.
        file: String,
        /// Line, caret and what was expected.
        detail: String,
    },
    /// A value outside what is allowed.
    #[error("{file}, line {line}: {key} = {found}, allowed is {allowed}")]
    Value {
        /// Path as given.
        file: String,
        /// Line counted from 1.
        line: usize,
        /// Full name of the key.
        key: String,
        /// What stands there.
        found: String,
        /// What may stand there.
        allowed: String,
    },
}

/// A TOML text and where it came from.
#[derive(Debug, Clone)]
pub struct Document {
    file: String,
    text: String,
}

impl Document {
    /// A text already in memory; `file` is its name in errors.
    pub fn new(file: impl Into<String>, text: impl Into<String>) -> Document {
        Document { file: file.into(), text: text.into() }
    }

    /// Reads a file.
    pub fn read(path: &Path) -> Result<Document, ConfigError> {
        let file = path.display().to_string();
        match std::fs::read_to_string(path) {
            Ok(text) => Ok(Document { file, text }),
            Err(cause) => Err(ConfigError::Read { file, cause }),
        }
    }

    /// The name used in errors.
    pub fn file(&self) -> &str {
        &self.file
    }

    /// The text itself.
    pub fn text(&self) -> &str {
        &self.text
    }

    /// Deserialises the whole text.
    pub fn parse<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        toml::from_str(&self.text).map_err(|e| ConfigError::Syntax {
            file: self.file.clone(),
            detail: e.to_string().trim_end().to_owned(),
        })
    }

    /// The value if it lies in the range (NaN never does).
    pub fn in_range(
        &self,
        value: &Spanned<f64>,
        key: &str,
        allowed: RangeInclusive<f64>,
    ) -> Result<f64, ConfigError> {
        let found = *value.get_ref();
        if allowed.contains(&found) {
            return Ok(found);
        }
        let allowed = format!("{} to {}", allowed.start(), allowed.end());
        Err(self.value_error(value.span(), key, found, allowed))
    }

    /// An error about the text at `span`.
    pub fn value_error(
        &self,
        span: Range<usize>,
        key: &str,
        found: impl Display,
        allowed: impl Display,
    ) -> ConfigError {
        let line = 1 + self.text.bytes().take(span.start).filter(|&b| b == b'\n').count();
        ConfigError::Value {
            file: self.file.clone(),
            line,
            key: key.to_owned(),
            found: found.to_string(),
            allowed: allowed.to_string(),
        }
    }
}
