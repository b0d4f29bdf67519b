//! What could be known at best: the same scans as benderd has, read by somebody who knows the plant's laws and how everything
//! scatters, and only not what was drawn for this job. No controller can do better but by chance.
//!
//! Every unknown of the plant is a grid of possibilities with their weights (Bayes); what is Gaussian given these is kept as
//! such: a program's residuals per bend in [`angles`]; [`feeds`] and [`turns`] have nothing else that stays.

pub mod angles;
pub mod feeds;
pub mod turns;

/// Weights from logarithms of likelihoods; together 1.
fn normalised(logs: &[f64]) -> Vec<f64> {
    let most = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let raw: Vec<f64> = logs.iter().map(|log| (log - most).exp()).collect();
    let sum: f64 = raw.iter().sum();
    raw.iter().map(|weight| weight / sum).collect()
}

/// Logarithm of a normal density, but for a constant.
fn log_normal(off: f64, variance: f64) -> f64 {
    -0.5 * (off * off / variance + variance.ln())
}

/// Middles of equally likely parts of a normal distribution, in sigmas.
fn normal_middles(count: usize) -> Vec<f64> {
    (0..count).map(|k| quantile((k as f64 + 0.5) / count as f64)).collect()
}

/// The normal distribution's quantile, by halving: this is not hot.
fn quantile(share: f64) -> f64 {
    let (mut low, mut high) = (-9.0, 9.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        *(if below(middle) < share { &mut low } else { &mut high }) = middle;
    }
    0.5 * (low + high)
}

/// Share of a normal distribution below so many sigmas: the density summed up in 400 steps.
fn below(sigmas: f64) -> f64 {
    const STEPS: u32 = 400;
    let width = sigmas / f64::from(STEPS);
    let density = |x: f64| (-0.5 * x * x).exp() / std::f64::consts::TAU.sqrt();
    0.5 + (0..STEPS).map(|k| density((f64::from(k) + 0.5) * width) * width).sum::<f64>()
}
