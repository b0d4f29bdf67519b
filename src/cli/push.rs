//! `benderd push`: delivers one table by hand, through the same gate and handshake as the daemon.

use std::io::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail};
use serde::{Deserialize, Serialize};

use super::{Outcome as Exit, endpoint_of, push_text, run_on, say};
use crate::bender::{
    ActiveTable, Bender as _, Intent, IntentLog as _, Job, Link, Operation, Outcome, Profile, Reason, Status,
    TableId, check_program, deliver, gate, objections, prepare,
};
use crate::cell::JournalledIntents;
use crate::config::{Table, read_table};
use crate::correct::Verdict;
use crate::journal::Journal;
use crate::tube::{CommandTable, Lra};

/// Arguments of `benderd push`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The table: CSV (LRA, XYZ or YBC, told apart by the header) or the JSON of `benderd correct`.
    table: PathBuf,
    /// What kind of machine: a shipped profile's name or a profile file.
    #[arg(long, value_name = "PROFILE")]
    bender: String,
    /// Where the machine is; a path begins at this folder [default: the profile's endpoint].
    #[arg(long, value_name = "ADDRESS")]
    on: Option<String>,
    /// The program that must be loaded [default: the table's file name without its ending].
    #[arg(long, value_name = "NAME")]
    program: Option<String>,
    /// Corrects the table that was committed last for this program: the machine must still hold it, row for row, and no row is added
    /// or removed. Without it the rows are made anew, whatever the machine holds.
    #[arg(long)]
    correct: bool,
    /// The operator has seen that nothing is bent and the right program is loaded: needed for machines without a staging area, whose
    /// rows are in force as soon as they are written.
    #[arg(long)]
    approve: bool,
    /// Connects and reads, says what would be done, writes nothing.
    #[arg(long)]
    dry_run: bool,
    /// The journal [default: $STATE_DIRECTORY/journal.db, else benderd/journal.db in $XDG_STATE_HOME or
    /// ~/.local/state].
    #[arg(long, value_name = "FILE")]
    journal: Option<PathBuf>,
    /// Prints one JSON object.
    #[arg(long)]
    json: bool,
}

/// Everything that is known at the end; its JSON form is what `--json` prints.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub bender: String,
    pub endpoint: String,
    pub program: String,
    pub dry_run: bool,
    /// What the table's author had to say.
    pub notes: Vec<String>,
    /// The table in force before; absent when the machine could not be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub active: Option<TableId>,
    /// The table to be put in force.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub new: Option<TableId>,
    #[serde(flatten)]
    pub result: Ending,
    /// An earlier delivery whose outcome was open until now.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub resolved: Option<Outcome>,
    /// The journal's record of the outcome.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub record: Option<i64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub journal: Option<String>,
}

/// How it ended.
#[derive(Debug, Serialize)]
#[serde(untagged)]
pub(super) enum Ending {
    Delivered(Outcome),
    /// A dry run that met no objection.
    WouldApply {
        outcome: &'static str,
    },
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Exit> {
    let profile = Profile::load(&args.bender)?;
    let Commanded { table, notes, refusal } = read_commanded(&args.table)?;
    let program = match &args.program {
        Some(program) => program.clone(),
        None => args.table.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
    };
    check_program(&profile, &program)
        .map_err(|reason| anyhow!("{reason}; give the machine's own with --program NAME"))?;
    let endpoint = endpoint_of(&profile, args.on.as_deref())?;
    let mut report = Report {
        bender: profile.name.clone(),
        endpoint: endpoint.clone(),
        program: program.clone(),
        dry_run: args.dry_run,
        notes,
        active: None,
        new: None,
        result: Ending::WouldApply { outcome: "would_apply" },
        resolved: None,
        record: None,
        journal: None,
    };
    if !refusal.is_empty() {
        report.result = Ending::Delivered(Outcome::Rejected { reasons: refusal });
        return finish(args, &report);
    }
    let reads_journal = args.correct || !args.dry_run;
    let mut journal = if reads_journal { Some(open_journal(args.journal.as_deref())?) } else { None };
    let operation = match &mut journal {
        Some(journal) if args.correct => last_committed(journal, &endpoint, &program)?,
        _ => Operation::New,
    };
    let mut journal = journal.filter(|_| !args.dry_run);
    report.journal = journal.as_ref().map(|j| j.file().to_owned());
    if !args.json {
        report.notes.iter().for_each(|note| say(&format!("note      {note}\n")));
    }
    let job = Job { program, table, expected_active: None, operation, approved: args.approve };
    let mut link = Link::new(profile, endpoint)?;
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let report = run_on(runtime, push(args, &mut link, job, journal.as_mut(), report));
    finish(args, &report)
}

/// A correction of what was committed last.
fn last_committed(journal: &mut Journal, endpoint: &str, program: &str) -> anyhow::Result<Operation> {
    match JournalledIntents::new(journal, endpoint).last_applied(program)? {
        Some(last) => Ok(Operation::Correct { last }),
        None => bail!(
            "--correct: nothing that was committed to {endpoint} for program {program:?} is in {}; leave it out to make the rows anew",
            journal.file()
        ),
    }
}

/// Says how it ended.
fn finish(args: &Args, report: &Report) -> anyhow::Result<Exit> {
    if args.json {
        say(&format!("{}\n", serde_json::to_string_pretty(report)?));
    } else {
        let (out, err) = push_text::ending(report);
        if !out.is_empty() {
            say(&out);
        }
        let _ = std::io::stderr().write_all(err.as_bytes());
    }
    Ok(match &report.result {
        Ending::WouldApply { .. } => Exit::Done,
        Ending::Delivered(Outcome::Applied(_) | Outcome::AlreadyActive(_)) => Exit::Done,
        Ending::Delivered(Outcome::Rejected { .. } | Outcome::NotApplied { .. }) => Exit::No,
        Ending::Delivered(Outcome::Unknown { .. }) => Exit::Unknown,
    })
}

async fn push(
    args: &Args,
    link: &mut Link,
    mut job: Job,
    journal: Option<&mut Journal>,
    mut report: Report,
) -> Report {
    let look = look(link, &job).await;
    if let Ok(active) = &look {
        let active_id = active.status.active;
        job.expected_active = Some(active_id); // what is shown here is what may be replaced
        report.active = Some(active_id);
        if let Ok(prepared) = prepare(link.profile(), &job) {
            let same = active_id.revision != 0 && active_id.crc == prepared.crc;
            let revision = active_id
                .revision
                .wrapping_add(u32::from(!same && link.profile().transport.direct().is_none()));
            report.new = Some(TableId { revision, crc: prepared.crc });
        }
        if !args.json {
            say(&push_text::comparison(link.profile(), &report, &job, active));
        }
    }
    let Some(journal) = journal else {
        report.result = look
            .and_then(|active| rehearse(link.profile(), &job, &active))
            .map_or_else(Ending::Delivered, |outcome| {
                outcome.map_or(Ending::WouldApply { outcome: "would_apply" }, Ending::Delivered)
            });
        return report;
    };
    let mut log = JournalledIntents::new(journal, link.endpoint());
    let outcome = match look {
        Ok(active) => {
            report.resolved = resolve(&mut log, &active);
            deliver(link, &job, &mut log).await
        }
        Err(outcome) => {
            // A failure shows as a missing record below.
            let _ = log.outcome(&job, None::<&Intent>, &outcome);
            outcome
        }
    };
    report.record = log.recorded.as_ref().map(|r| r.seq);
    report.result = Ending::Delivered(outcome);
    report
}

/// Limits first, then the machine: what breaks a limit needs no connection.
async fn look(link: &mut Link, job: &Job) -> Result<ActiveTable, Outcome> {
    prepare(link.profile(), job).map_err(|reasons| Outcome::Rejected { reasons })?;
    link.read_active().await.map_err(|error| Outcome::NotApplied { why: error.to_string() })
}

/// What a delivery would meet: an objection, "already active", or nothing.
fn rehearse(profile: &Profile, job: &Job, active: &ActiveTable) -> Result<Option<Outcome>, Outcome> {
    let prepared = prepare(profile, job).map_err(|reasons| Outcome::Rejected { reasons })?;
    let mut reasons: Vec<Reason> = gate(profile, &prepared, &active.status);
    if let Operation::Correct { last } = &job.operation {
        reasons.extend(objections(profile, &job.program, last, &job.table, active));
    }
    let Status { active: in_force, pending, .. } = &active.status;
    if in_force.revision != 0 && in_force.crc == prepared.crc && pending.revision == 0 {
        return Ok(Some(Outcome::AlreadyActive(active.status.active)));
    }
    if reasons.is_empty() { Ok(None) } else { Err(Outcome::Rejected { reasons }) }
}

/// An earlier commit whose outcome stayed open is decided by what the machine holds now.
fn resolve(log: &mut JournalledIntents, active: &ActiveTable) -> Option<Outcome> {
    match log.resolve(active.status.active, active.status.pending) {
        Ok(resolved) => resolved,
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "warning: an open delivery could not be looked up: {error}");
            None
        }
    }
}

/// What `benderd correct` printed, as far as it matters here.
#[derive(Deserialize)]
struct Corrected {
    verdict: Verdict,
    commanded: CommandTable,
    #[serde(default)]
    reasons: Vec<CorrectedReason>,
}

#[derive(Deserialize)]
struct CorrectedReason {
    text: String,
}

/// What a file asks for.
struct Commanded {
    table: CommandTable,
    /// What its author had to say.
    notes: Vec<String>,
    /// Why it must not be sent.
    refusal: Vec<Reason>,
}

/// The table of a file, and whether its author lets it go.
fn read_commanded(path: &Path) -> anyhow::Result<Commanded> {
    let name = path.display();
    if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json")) {
        let text = std::fs::read_to_string(path).with_context(|| format!("{name}: cannot be read"))?;
        let corrected: Corrected = serde_json::from_str(&text).with_context(|| {
            format!("{name}: not the JSON of `benderd correct --json` (fields \"verdict\" and \"commanded\")")
        })?;
        corrected.commanded.validate().with_context(|| name.to_string())?;
        let notes: Vec<String> = corrected.reasons.into_iter().map(|r| r.text).collect();
        let refusal = refuse_verdict(corrected.verdict, &notes);
        return Ok(Commanded { table: corrected.commanded, notes, refusal });
    }
    let lra = match read_table(path)? {
        Table::Lra(lra) => lra,
        Table::Ybc(ybc) => Lra::from(&ybc),
        Table::Xyz(polygon) => polygon.to_lra().with_context(|| name.to_string())?.0,
    };
    Ok(Commanded { table: CommandTable::from_lra(&lra), notes: Vec::new(), refusal: Vec::new() })
}

/// In hold and rescan the table of the answer is the one in force, not one to send.
fn refuse_verdict(verdict: Verdict, notes: &[String]) -> Vec<Reason> {
    let said = match verdict {
        Verdict::FirstPiece | Verdict::Correct | Verdict::InTolerance => return Vec::new(),
        Verdict::Hold => "the correction's verdict is hold: nothing is sent before this is cleared",
        Verdict::Rescan => "the correction's verdict is rescan: scan the same tube again, then correct anew",
    };
    let texts = std::iter::once(said).chain(notes.iter().map(String::as_str));
    texts.map(|text| Reason::new("verdict", None, text)).collect()
}

/// The journal of a service is in its state directory, a person's in theirs.
fn open_journal(given: Option<&Path>) -> anyhow::Result<Journal> {
    if let Some(path) = given {
        return Ok(Journal::open(path)?);
    }
    let folder = if let Some(service) = std::env::var_os("STATE_DIRECTORY") {
        PathBuf::from(service)
    } else if let Some(state) = std::env::var_os("XDG_STATE_HOME").filter(|s| !s.is_empty()) {
        PathBuf::from(state).join("benderd")
    } else if let Some(home) = std::env::home_dir() {
        home.join(".local/state/benderd")
    } else {
        bail!("no place for the journal: set HOME or give --journal FILE");
    };
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("{}: the journal's folder cannot be made", folder.display()))?;
    Ok(Journal::open(&folder.join("journal.db"))?)
}
