//! Performs what [`Delivery`] asks for, on a link and a journal. The only async part of the handshake, and a
//! thin one: no decision is taken here.

use tokio::time::{Duration, Instant};

use super::delivery::{Action, Delivery, Event, Intent, Job, Outcome};
use super::link::{Bender, LinkError};

/// Why the journal could not take something.
pub type LogError = Box<dyn std::error::Error + Send + Sync>;

/// Where intents and outcomes are kept. An intent must be on disk when `intent` returns.
pub trait IntentLog: Send {
    /// Before the commit.
    fn intent(&mut self, intent: &Intent) -> Result<(), LogError>;

    /// Whether the commit is still wanted: asked right before it, since staging takes time. Else why not.
    fn still_wanted(&self) -> Result<(), String> {
        Ok(())
    }

    /// After it, or in its stead; `intent` is the one journalled in this delivery, if it came that far.
    fn outcome(&mut self, job: &Job, intent: Option<&Intent>, outcome: &Outcome) -> Result<(), LogError>;
}

/// Delivers one table. Every delivery ends, within the profile's deadlines, and leaves its outcome in the log;
/// where the log refuses that, the intent before it stands and the next contact resolves it.
pub async fn deliver<B: Bender>(bender: &mut B, job: &Job, log: &mut dyn IntentLog) -> Outcome {
    let start = Instant::now();
    let (mut delivery, mut action) = Delivery::start(bender.profile(), job);
    let mut journalled = None;
    loop {
        let event = match action {
            Action::ReadStatus => answer(bender.read_status().await, Event::StatusRead),
            Action::WriteStaging(staged) => answer(bender.write_staging(&staged).await, |()| Event::Written),
            Action::ReadStaging { bytes } => answer(bender.read_staging(bytes).await, Event::ReadBack),
            Action::JournalIntent(intent) => match journal(log, &intent) {
                Ok(()) => {
                    tracing::info!(program = intent.program, new = %intent.new, old = %intent.old, "committing");
                    journalled = Some(intent);
                    Event::IntentJournalled
                }
                Err(why) => Event::Failed(why),
            },
            Action::Commit(id) => answer(bender.commit(id).await, |()| Event::Committed),
            Action::ReadActive => answer(bender.read_active().await, Event::ActiveRead),
            Action::Wait { until_ms } => {
                tokio::time::sleep_until(start + Duration::from_millis(until_ms)).await;
                Event::Timeout
            }
            Action::Finish(outcome) => {
                if let Err(error) = log.outcome(job, journalled.as_ref(), &outcome) {
                    tracing::error!(%error, ?outcome, "the outcome could not be journalled");
                }
                show_frames(bender, &outcome);
                return outcome;
            }
        };
        let now_ms = u64::try_from(start.elapsed().as_millis()).unwrap_or(u64::MAX);
        action = delivery.on(event, now_ms);
    }
}

/// The intent on disk, and the commit wanted before and after that: a disk can be slow.
fn journal(log: &mut dyn IntentLog, intent: &Intent) -> Result<(), String> {
    log.still_wanted()?;
    log.intent(intent).map_err(|error| format!("the intent could not be journalled: {error}"))?;
    log.still_wanted()
}

/// What went over the link before a delivery that did not do what was wanted.
fn show_frames<B: Bender>(bender: &B, outcome: &Outcome) {
    let wanted = matches!(outcome, Outcome::Applied(_) | Outcome::AlreadyActive(_));
    if !wanted && tracing::enabled!(tracing::Level::DEBUG) {
        for line in bender.last_frames() {
            tracing::debug!(endpoint = bender.endpoint(), "{line}");
        }
    }
}

fn answer<T>(result: Result<T, LinkError>, event: impl FnOnce(T) -> Event) -> Event {
    match result {
        Ok(value) => event(value),
        Err(error) => Event::Failed(error.to_string()),
    }
}
