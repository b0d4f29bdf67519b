//! `benderd simulate bender`: a bender on whatever link its profile names, until Ctrl-C or SIGTERM.

use std::path::PathBuf;

use anyhow::{anyhow, bail};
use tokio::signal::unix::{SignalKind, signal};

use super::{Outcome, run_on, say};
use crate::bender::{Profile, Transport};
use crate::sim::bender::{MachineEvent, MachineModel};
use crate::sim::bender_server::SimulatedBender;
use crate::sim::door::Door;
use crate::sim::faults::Fault;
use crate::sim::script;
use crate::sim::trouble::WireFaults;

/// Arguments of `benderd simulate bender`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// What kind of machine: a shipped profile's name or a profile file.
    #[arg(long, default_value = "reference-modbus")]
    profile: String,
    /// Where to be reached [default: the profile's endpoint]: HOST:PORT, port 0 takes a free one; for a serial profile a path: the
    /// device there, or a pseudo terminal that is made under this name; a folder; a CAN interface.
    #[arg(long, value_name = "ADDRESS")]
    on: Option<String>,
    /// Name of the loaded program.
    #[arg(long, default_value = "bracket-17")]
    program: String,
    /// Bends of the loaded program.
    #[arg(long, default_value_t = 4)]
    bends: u16,
    /// A way to misbehave: silent, late:MS, other-program, other-bends, running, corrupt-staging,
    /// drop-before-apply, drop-after-apply, silent-after-commit, busy, frozen.
    #[arg(long)]
    fault: Option<Fault>,
    /// What goes wrong and when: a TOML file as config/faults.toml.
    #[arg(long, value_name = "FILE", conflicts_with = "seed")]
    script: Option<PathBuf>,
    /// Faults by chance that this number decides: answers lost, late, damaged, busy; power off and on.
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Of a thousand answers so many meet one.
    #[arg(long, value_name = "P", default_value_t = 100, requires = "seed", value_parser = clap::value_parser!(u32).range(0..=1000))]
    per_mille: u32,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    let profile = Profile::load(&args.profile)?;
    let longest = profile.table.program_bytes;
    if args.program.is_empty() || args.program.len() > longest || !args.program.is_ascii() {
        bail!("--program {:?}: allowed are 1 to {longest} ASCII characters", args.program);
    }
    if usize::from(args.bends) > profile.limits.max_bends {
        bail!("--bends {}: profile {} has room for {}", args.bends, profile.name, profile.limits.max_bends);
    }
    let faults = match (&args.script, args.seed) {
        (Some(file), _) => Some(WireFaults::events(script::load(file)?)),
        (None, seed) => seed.map(|seed| WireFaults::by_chance(&profile, seed, args.per_mille)),
    };
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    run_on(runtime, serve(args, profile, faults))
}

async fn serve(args: &Args, profile: Profile, faults: Option<WireFaults>) -> anyhow::Result<Outcome> {
    let on = args.on.clone().unwrap_or_else(|| profile.endpoint.clone());
    let (door, _kept) = Door::open(&profile, &on).await.map_err(|error| {
        anyhow!("--on {on}: cannot listen: {error}; allowed is {}", form(&profile.transport))
    })?;
    let name = profile.name.clone();
    let model = MachineModel::new(profile, &args.program, args.bends);
    let bender = SimulatedBender::start(door, model, args.fault, |event| say(&describe(&event)))?;
    bender.set_wire_faults(faults);
    say(&format!(
        "simulated bender {name} listens on {}; program {:?} with {} bends is loaded",
        bender.address(),
        args.program,
        args.bends
    ));
    let mut terminate = signal(SignalKind::terminate())?;
    tokio::select! {
        _ = terminate.recv() => {}
        result = tokio::signal::ctrl_c() => result?,
    }
    say("stopped");
    Ok(Outcome::Done)
}

/// What `--on` takes, in words.
fn form(transport: &Transport) -> &'static str {
    match transport {
        Transport::ModbusTcp(_) | Transport::ModbusRtuOverTcp(..) => {
            "an address of this computer and a port of 0 (a free one is taken) to 65535, for instance 127.0.0.1:5020"
        }
        Transport::ModbusRtu(..) | Transport::SerialTable(..) => {
            "the path of a serial port, or a name for a pseudo terminal that is made where it may be: --on ./line"
        }
        Transport::Folder(_) => "a folder that is there: mkdir folder, then --on ./folder",
        Transport::Can(_) | Transport::Canopen(_) => "a CAN interface that is up, for instance vcan0",
    }
}

fn describe(event: &MachineEvent) -> String {
    match event {
        MachineEvent::Trouble(what) => format!("trouble at {what}"),
        MachineEvent::TakenOver { id, program, bends } => {
            format!("table taken over: {id}, program {program:?}, {bends} bends")
        }
        MachineEvent::Refused { id, code } => {
            format!("commit refused with code {code} ({}): {id}", crate::bender::Ack::meaning(*code))
        }
    }
}
