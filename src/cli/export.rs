//! `--export`: what was reconstructed as files for people and other programs, told apart by the name's ending.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};

use crate::cell::MeasuredScan;
use crate::cloud::write_coloured_ply;
use crate::report::{About, Scale, html, spine_csv};

/// What is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Form {
    /// The spine as points (.csv).
    Spine,
    /// The cloud coloured by deviation (.ply).
    Deviation,
    /// The page (.html).
    Report,
}

/// A file to be written.
#[derive(Debug, Clone)]
pub struct Export {
    path: PathBuf,
    form: Form,
}

impl std::str::FromStr for Export {
    type Err = String;

    fn from_str(text: &str) -> Result<Export, String> {
        let path = PathBuf::from(text);
        let ending = path.extension().map(|e| e.to_string_lossy().to_lowercase());
        let form = match ending.as_deref() {
            Some("csv") => Form::Spine,
            Some("ply") => Form::Deviation,
            Some("html") => Form::Report,
            Some(other) => return Err(format!("found the ending .{other}; {ENDINGS}")),
            None => return Err(format!("the name has no ending; {ENDINGS}")),
        };
        Ok(Export { path, form })
    }
}

const ENDINGS: &str =
    "allowed are .csv (the spine), .ply (the points coloured by deviation) and .html (the report)";

/// Refuses exports over the scan that they are made of or over each other, before any work is done.
pub fn check(exports: &[Export], scan: &Path) -> anyhow::Result<()> {
    let place = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    for (i, export) in exports.iter().enumerate() {
        let path = export.path.display();
        if place(&export.path) == place(scan) {
            bail!("{path}: this is the scan itself; export to another name");
        }
        if exports[..i].iter().any(|e| place(&e.path) == place(&export.path)) {
            bail!("{path}: named twice; give every export a name of its own");
        }
    }
    Ok(())
}

impl Export {
    /// Writes the file; `file` is the scan's name as given, `nominal` the part's.
    pub fn write(&self, file: &str, nominal: Option<&str>, scan: &MeasuredScan) -> anyhow::Result<()> {
        let text = match self.form {
            Form::Deviation => return self.write_cloud(scan),
            Form::Spine => spine_csv(&scan.found.spine),
            Form::Report => html(&About { file, nominal }, &scan.found, &scan.cloud),
        };
        let path = self.path.display();
        std::fs::write(&self.path, text).with_context(|| format!("{path}: cannot be written"))
    }

    fn write_cloud(&self, scan: &MeasuredScan) -> anyhow::Result<()> {
        let residuals = scan.found.residuals_mm(&scan.cloud);
        let scale = Scale::of(&scan.found, &residuals);
        let colours: Vec<[u8; 3]> = residuals.iter().map(|r| scale.colour(*r)).collect();
        Ok(write_coloured_ply(&self.path, &scan.cloud, &colours, &residuals)?)
    }
}
