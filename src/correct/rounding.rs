//! The best values of a table where each has a range and may come in whole steps only: least squares, rounded along the tube.
//!
//! The cost is a quadratic of all values. They are settled in order, each at the nearest it may have to what is best now that
//! those before it stand, all later ones still free (L. Babai 1986): so what rounding leaves over is made up for
//! behind it. Then single values and pairs move on while that gains something.

use nalgebra::{DMatrix, DVector};

/// What one value may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Choice {
    /// From here.
    pub low: f64,
    /// To here.
    pub high: f64,
    /// In whole steps of this; 0: anything.
    pub step: f64,
}

/// Cost of moving all values by `x` from where they begin: x' curvature x + 2 slope' x.
#[derive(Debug, Clone)]
pub struct Quadratic {
    /// Symmetric, positive definite.
    pub curvature: DMatrix<f64>,
    /// At the beginning.
    pub slope: DVector<f64>,
}

/// Most rounds in which values that came to their ends are held there, and most moves afterwards.
const ROUNDS: usize = 6;
const MOVES: usize = 200;
/// A move that gains less than this share of the unit of cost is none.
const GAIN: f64 = 1e-6;

impl Choice {
    /// The allowed value nearest to one; without a whole step in the range, the step nearest to its middle.
    pub fn nearest(&self, value: f64) -> f64 {
        if self.step <= 0.0 {
            return value.max(self.low).min(self.high);
        }
        let (least, most) = ((self.low / self.step - 1e-6).ceil(), (self.high / self.step + 1e-6).floor());
        let wanted = (value / self.step).round();
        let middle = ((self.low + self.high) / (2.0 * self.step)).round();
        (if least <= most { wanted.max(least).min(most) } else { middle }) * self.step
    }

    /// Whether there is a value in the range.
    pub fn has_any(&self) -> bool {
        self.step <= 0.0 || (self.low..=self.high).contains(&self.nearest(self.low))
    }

    fn is_one(&self) -> bool {
        self.nearest(self.low) == self.nearest(self.high)
    }
}

/// The values that cost least, as far as this finds them; `start` is where the quadratic begins.
pub fn choose(cost: &Quadratic, start: &[f64], choices: &[Choice]) -> Vec<f64> {
    let mut choices = choices.to_vec();
    let mut found: Vec<f64> = start.iter().zip(&choices).map(|(v, c)| c.nearest(*v)).collect();
    for _ in 0..ROUNDS {
        let Some(settled) = in_order(cost, start, &choices) else { break };
        found = settled.iter().map(|s| s.value).collect();
        // What would go beyond its range is held at its end from the beginning, for all others to know.
        let mut held = false;
        for (s, choice) in settled.iter().zip(&mut choices) {
            if !choice.is_one() && (s.value - s.wanted).abs() > 0.5 * choice.step + 1e-12 {
                (choice.low, choice.high, held) = (s.value, s.value, true);
            }
        }
        if !held {
            break;
        }
    }
    found
}

/// A value and what it would have been without its range and steps.
struct Settled {
    value: f64,
    wanted: f64,
}

/// Values that cannot move first, then the others as they come.
fn in_order(cost: &Quadratic, start: &[f64], choices: &[Choice]) -> Option<Vec<Settled>> {
    let (mut order, free): (Vec<usize>, Vec<usize>) = (0..start.len()).partition(|&k| choices[k].is_one());
    order.extend(free);
    // The factor's last row stands alone, each one before it needs those after: so the first is put last.
    order.reverse();
    let n = order.len();
    let curvature = DMatrix::from_fn(n, n, |r, c| cost.curvature[(order[r], order[c])]);
    let factor = curvature.cholesky()?.unpack();
    let slope = factor.solve_lower_triangular(&DVector::from_fn(n, |r, _| cost.slope[order[r]]))?;
    let mut moved = DVector::zeros(n);
    let mut out: Vec<Settled> = start.iter().map(|v| Settled { value: *v, wanted: *v }).collect();
    for r in (0..n).rev() {
        let k = order[r];
        let after = factor.view((r + 1, r), (n - r - 1, 1)).dot(&moved.rows(r + 1, n - r - 1));
        let wanted = start[k] - (slope[r] + after) / factor[(r, r)];
        let value = choices[k].nearest(wanted);
        moved[r] = value - start[k];
        out[k] = Settled { value, wanted };
    }
    Some(out)
}

/// Moves single values to their best, and pairs by a step each, while that gains something.
pub fn polish(cost: &Quadratic, start: &[f64], choices: &[Choice], mut values: Vec<f64>) -> Vec<f64> {
    let moved = DVector::from_iterator(start.len(), values.iter().zip(start).map(|(v, s)| v - s));
    let mut slope = &cost.slope + &cost.curvature * moved;
    for _ in 0..MOVES {
        let Some(best) = best_move(cost, &slope, choices, &values) else { break };
        for (k, by) in best {
            values[k] += by;
            slope += cost.curvature.column(k) * by;
        }
    }
    values
}

type Move = Vec<(usize, f64)>;

fn best_move(cost: &Quadratic, slope: &DVector<f64>, choices: &[Choice], values: &[f64]) -> Option<Move> {
    let a = &cost.curvature;
    let one = |k: usize, by: f64| by * (a[(k, k)] * by + 2.0 * slope[k]);
    let mut best = (-GAIN, None);
    let mut steps: Vec<(usize, f64, f64)> = Vec::new();
    for (k, (choice, value)) in choices.iter().zip(values).enumerate() {
        let by = choice.nearest(value - slope[k] / a[(k, k)]) - value;
        if one(k, by) < best.0 {
            best = (one(k, by), Some(vec![(k, by)]));
        }
        let ways = [choice.step, -choice.step].map(|step| choice.nearest(value + step) - value);
        steps.extend(ways.into_iter().filter(|by| *by != 0.0).map(|by| (k, by, one(k, by))));
    }
    for (i, &(k, by, alone)) in steps.iter().enumerate() {
        for &(l, other, its) in &steps[i + 1..] {
            let both = alone + its + 2.0 * a[(k, l)] * by * other;
            if l != k && both < best.0 {
                best = (both, Some(vec![(k, by), (l, other)]));
            }
        }
    }
    best.1
}
