//! `benderd knowledge`: what was learned of spring-back, told, drawn, put in and given out.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use clap::Subcommand;
use serde_json::json;

use super::{Outcome, knowledge_text, say};
use crate::config::{Materials, load_part, read_springback};
use crate::correct::knowledge::{Key, KeyRecord, VERSION};
use crate::correct::summary::{Listed, Pairs, Shown};
use crate::correct::{Knowledge, SetUp, import, store};
use crate::report::springback_svg;
use crate::tube::Material;

/// Arguments of `benderd knowledge`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, Subcommand)]
enum What {
    /// Lists the keys: material, tube, die and set-up, how much was measured, spring-back at 20, 90 and 120 degrees.
    List(List),
    /// Shows one key: the law with its band, what opens the arc, backlash, every measurement; draws it.
    Show(Show),
    /// Takes in another knowledge file, a controller's pair, a shop's overbend list or a bent test tube.
    Import(Import),
    /// Prints what is known as a knowledge file, or one key as the pair at 20 and 120 degrees that controllers keep.
    Export(Export),
}

/// The file, and what its materials are.
#[derive(Debug, clap::Args)]
struct Source {
    /// The knowledge file, as `correct --knowledge` writes it.
    #[arg(long, value_name = "FILE")]
    knowledge: PathBuf,
    /// Materials file instead of the built-in one.
    #[arg(long, value_name = "FILE")]
    materials: Option<PathBuf>,
}

#[derive(Debug, clap::Args)]
struct List {
    #[command(flatten)]
    source: Source,
    /// Prints one JSON object.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, clap::Args)]
struct Show {
    /// Number of the key in `list`; not needed where there is only one.
    key: Option<usize>,
    #[command(flatten)]
    source: Source,
    /// Prints one JSON object.
    #[arg(long)]
    json: bool,
    /// Also draws spring-back against the angle as SVG.
    #[arg(long, value_name = "FILE.svg", value_parser = svg_file)]
    picture: Option<PathBuf>,
}

#[derive(Debug, clap::Args)]
#[command(after_long_help = IMPORT_HELP)]
struct Import {
    /// What to take in: a knowledge file, or a CSV told apart by its header.
    file: PathBuf,
    #[command(flatten)]
    source: Source,
    /// The part file whose tube, material and die a CSV is of.
    #[arg(long, value_name = "PART")]
    nominal: Option<PathBuf>,
    /// Name of the bender that a CSV is of.
    #[arg(long, default_value = "", hide_default_value = true)]
    bender: String,
    /// Lubrication set-up that a CSV is of.
    #[arg(long, default_value = "", hide_default_value = true)]
    lubrication: String,
    /// Batch of the test tube.
    #[arg(long)]
    batch: Option<String>,
}

#[derive(Debug, clap::Args)]
struct Export {
    /// Number of the key in `list`; without it all keys, or the only one's pair.
    key: Option<usize>,
    #[command(flatten)]
    source: Source,
    /// The pair at 20 and 120 degrees, by the drawing's angle and by the commanded one.
    #[arg(long)]
    pair: bool,
    /// The pair as one JSON object; a knowledge file is one anyway.
    #[arg(long, requires = "pair")]
    json: bool,
}

const IMPORT_HELP: &str = "\
CSV files have two columns, angles in degrees, and one of these headers:
  designed_deg,springback_deg    a controller's pair, looked up with the drawing's angle
  commanded_deg,springback_deg   a controller's pair, looked up with the angle that the machine bends to
  angle_deg,overbend_deg         a shop's list: the drawing's angle, and how much more is bent
  commanded_deg,measured_deg     a test tube of two bends or more: what was commanded, what was measured on it
A pair or list is told, not measured: it counts like two bends known to 0.3 degrees, and takes the place of the one told
before. A test counts like bends known to 0.17 degrees. A job comes in once; of the same job the record with more tubes stays.";

fn svg_file(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let fits = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("svg"));
    fits.then_some(path).ok_or_else(|| "the name has to end in .svg".to_owned())
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    match &args.what {
        What::List(args) => list(args)?,
        What::Show(args) => show(args)?,
        What::Import(args) => take_in(args)?,
        What::Export(args) => give_out(args)?,
    }
    Ok(Outcome::Done)
}

fn list(args: &List) -> anyhow::Result<()> {
    let materials = Materials::load(args.source.materials.as_deref())?;
    let known = store::load_present(&args.source.knowledge)?;
    let listed = (1..).zip(&known.keys).map(|(i, k)| Listed::of(i, k, materials.get(&k.key.material)));
    let listed: Vec<Listed> = listed.collect();
    say(&if args.json { json!({"keys": listed}).to_string() } else { knowledge_text::list(&listed) });
    Ok(())
}

fn show(args: &Show) -> anyhow::Result<()> {
    let known = store::load_present(&args.source.knowledge)?;
    let (number, record, material) = one(&args.source, &known, args.key)?;
    let shown = Shown::of(number, record, &material);
    if let Some(path) = &args.picture {
        let svg = springback_svg(record, &material);
        std::fs::write(path, svg).with_context(|| format!("{}: cannot be written", path.display()))?;
    }
    say(&if args.json { serde_json::to_string(&shown)? } else { knowledge_text::show(&shown) });
    Ok(())
}

fn take_in(args: &Import) -> anyhow::Result<()> {
    let path = &args.source.knowledge;
    let before = store::load(path)?;
    let mut known = before.clone();
    let said = if is_json(&args.file)? {
        if args.nominal.is_some() || args.batch.is_some() {
            bail!(
                "{}: a knowledge file says itself what it is of: leave --nominal and --batch out",
                args.file.display()
            );
        }
        knowledge_text::merged(import::merge(&mut known, &store::load_present(&args.file)?))
    } else {
        let table = read_springback(&args.file)?;
        let Some(part) = &args.nominal else {
            bail!(
                "{}: a CSV does not say what it is of: name the part by --nominal, and --bender and --lubrication as the jobs do",
                args.file.display()
            );
        };
        let nominal = load_part(part, &Materials::load(args.source.materials.as_deref())?)?;
        let set_up = SetUp { bender: args.bender.clone(), lubrication: args.lubrication.clone() };
        let key = Key::of(&nominal, &set_up);
        let record = import::record(&table, key.clr_mm, args.batch.as_deref());
        let said = knowledge_text::put(&key, &record);
        known.put(&key, record);
        said
    };
    if known == before {
        say(&format!("{}: nothing new in {}", path.display(), args.file.display()));
        return Ok(());
    }
    store::save(path, &known)?;
    say(&format!("{}: {said}", path.display()));
    Ok(())
}

fn give_out(args: &Export) -> anyhow::Result<()> {
    let known = store::load_present(&args.source.knowledge)?;
    if args.pair {
        let (_, record, material) = one(&args.source, &known, args.key)?;
        let pairs = Pairs::of(record, &material);
        say(&if args.json { serde_json::to_string(&pairs)? } else { knowledge_text::pairs(&pairs) });
        return Ok(());
    }
    let keys = match args.key {
        None => known.keys,
        number => vec![numbered(&args.source, &known, number)?.1.clone()],
    };
    say(&serde_json::to_string_pretty(&Knowledge { version: VERSION, keys })?);
    Ok(())
}

/// The key that is asked for, and its material.
fn one<'a>(
    source: &Source,
    known: &'a Knowledge,
    number: Option<usize>,
) -> anyhow::Result<(usize, &'a KeyRecord, Material)> {
    let materials = Materials::load(source.materials.as_deref())?;
    let (number, record) = numbered(source, known, number)?;
    let name = &record.key.material;
    let keys = || materials.keys().collect::<Vec<_>>().join(", ");
    let material = materials.get(name).cloned().with_context(|| {
        format!(
            "key {number}: material {name:?} is not in the materials file ({}): name one by --materials",
            keys()
        )
    })?;
    Ok((number, record, material))
}

fn numbered<'a>(
    source: &Source,
    known: &'a Knowledge,
    number: Option<usize>,
) -> anyhow::Result<(usize, &'a KeyRecord)> {
    known.numbered(number).map_err(|e| anyhow::anyhow!("{}: {e}", source.knowledge.display()))
}

fn is_json(path: &Path) -> anyhow::Result<bool> {
    let text =
        std::fs::read_to_string(path).with_context(|| format!("{}: cannot be read", path.display()))?;
    Ok(text.trim_start().starts_with('{'))
}
