//! `benderd run`: the daemon. All cells of benderd.toml until SIGTERM or Ctrl-C.
//!
//! Cells that may write come up disarmed. SIGUSR1 arms all of them, SIGUSR2 disarms them; `--arm` is for a person
//! who stands beside the machines.

use std::io::IsTerminal as _;
use std::path::PathBuf;

use anyhow::Context as _;
use sd_notify::NotifyState;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::{broadcast, mpsc};
use tokio::task::JoinSet;

use super::check::load;
use super::{Outcome, run_on};
use crate::arm::WatchedFolder;
use crate::bender::Link;
use crate::cell::{Chain, Command, Driver, Notice, Setup};
use crate::journal::Journal;

/// Arguments of `benderd run`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The daemon's configuration.
    #[arg(long, value_name = "FILE")]
    config: PathBuf,
    /// Arms the cells at once; without it they wait for SIGUSR1.
    #[arg(long)]
    arm: bool,
}

/// Runs the subcommand.
pub fn run(args: &Args) -> anyhow::Result<Outcome> {
    start_log();
    let loaded = load(&args.config)?;
    let state_dir = &loaded.config.state_dir;
    std::fs::create_dir_all(state_dir).with_context(|| format!("{}: cannot be made", state_dir.display()))?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build()?;
    let daemon = async {
        let mut daemon = Daemon::default();
        for setup in loaded.setups {
            daemon.start(setup, &state_dir.join("journal.db")).await?;
        }
        daemon.run(args.arm).await
    };
    run_on(runtime, daemon)
}

/// To stderr, where journald adds the time itself.
fn start_log() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env().unwrap_or_else(|_| "info".into());
    let log =
        tracing_subscriber::fmt().with_writer(std::io::stderr).with_target(false).with_env_filter(filter);
    let log = log.with_ansi(std::io::stderr().is_terminal());
    match std::env::var_os("JOURNAL_STREAM") {
        Some(_) => log.without_time().init(),
        None => log.init(),
    }
}

#[derive(Default)]
struct Daemon {
    cells: Vec<Running>,
    tasks: JoinSet<()>,
}

/// One started cell.
struct Running {
    name: String,
    commands: mpsc::Sender<Command>,
    notices: Option<broadcast::Receiver<Notice>>,
    status: String,
}

impl Daemon {
    async fn start(&mut self, setup: Setup, journal: &std::path::Path) -> anyhow::Result<()> {
        let name = setup.identity.name.clone();
        let source = WatchedFolder::open(setup.folder).await.with_context(|| format!("cell {name}"))?;
        let bender = Link::new(setup.profile, setup.address)?;
        let journals = [Journal::open(journal)?, Journal::open(journal)?];
        let driver: Driver<_, Chain> = Driver::new(setup.identity, bender, source, setup.chain, journals)?;
        let (commands, receiver) = mpsc::channel(8);
        let notices = Some(driver.listen());
        self.tasks.spawn(driver.run(receiver));
        self.cells.push(Running { name, commands, notices, status: "starting".into() });
        Ok(())
    }

    async fn run(mut self, arm: bool) -> anyhow::Result<Outcome> {
        let (changes, mut changed) = mpsc::channel(64);
        for (index, cell) in self.cells.iter_mut().enumerate() {
            if let Some(notices) = cell.notices.take() {
                tokio::spawn(forward(index, notices, changes.clone()));
            }
        }
        let mut terminate = signal(SignalKind::terminate())?;
        let mut arming = signal(SignalKind::user_defined1())?;
        let mut disarming = signal(SignalKind::user_defined2())?;
        if arm {
            self.tell(Command::Arm);
        }
        notify(&[NotifyState::Ready]);
        loop {
            tokio::select! {
                _ = terminate.recv() => break,
                result = tokio::signal::ctrl_c() => { result?; break }
                _ = arming.recv() => self.tell(Command::Arm),
                _ = disarming.recv() => self.tell(Command::Disarm),
                Some((index, status)) = changed.recv() => {
                    self.cells[index].status = status;
                    let all: Vec<String> = self.cells.iter().map(|c| format!("{}: {}", c.name, c.status)).collect();
                    notify(&[NotifyState::Status(&all.join("; "))]);
                }
                Some(ended) = self.tasks.join_next() => {
                    // A cell ends only when it is told to: anything else is a fault of the program.
                    ended.context("a cell has broken down")?;
                    anyhow::bail!("a cell has stopped by itself");
                }
            }
        }
        tracing::info!("stopping; a delivery under way is brought to its end");
        notify(&[NotifyState::Stopping]);
        self.cells.clear(); // drops the command channels, which ends the drivers
        while self.tasks.join_next().await.is_some() {}
        Ok(Outcome::Done)
    }

    fn tell(&self, command: Command) {
        for cell in &self.cells {
            tracing::info!(cell = cell.name, ?command, "told by signal");
            if let Err(error) = cell.commands.try_send(command) {
                tracing::error!(cell = cell.name, %error, "the cell takes no commands");
            }
        }
    }
}

/// A cell's changes of state to the daemon's status line.
async fn forward(
    index: usize,
    mut notices: broadcast::Receiver<Notice>,
    changes: mpsc::Sender<(usize, String)>,
) {
    loop {
        match notices.recv().await {
            Ok(Notice::State(state)) => {
                if changes.send((index, state.to_string())).await.is_err() {
                    return;
                }
            }
            Ok(Notice::Decided(_)) | Err(broadcast::error::RecvError::Lagged(_)) => {}
            Err(broadcast::error::RecvError::Closed) => return,
        }
    }
}

/// To the service manager, if there is one.
fn notify(state: &[NotifyState]) {
    if let Err(error) = sd_notify::notify(state) {
        tracing::warn!(%error, "the service manager could not be told");
    }
}
