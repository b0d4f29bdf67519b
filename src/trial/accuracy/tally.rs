//! Many cases taken together: errors, errors over their bounds, coverage of the reported sigmas, and the targets.

use super::{Case, Kind, Set, Value, Verdict};

/// The rms of error over bound on round tubes may be this, for angle, rotation and intersection distance.
const MOST_OVER_BOUND: f64 = 1.15;

/// From this many values on, the coverage of a kind is held to its target.
const ENOUGH_VALUES: usize = 5000;

/// Sizes of errors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Errors {
    /// Values given.
    pub given: usize,
    /// Values asked for and not given.
    pub not_given: usize,
    /// Median size.
    pub median: f64,
    /// Size that 95 % stay below.
    pub most: f64,
    /// Largest size.
    pub largest: f64,
}

/// Shares of the errors within one and two reported sigmas.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Coverage {
    /// Values with a sigma.
    pub count: usize,
    /// Share within one.
    pub one: f64,
    /// Share within two.
    pub two: f64,
}

/// The sizes of some values' errors.
pub fn errors<'a>(values: impl Iterator<Item = &'a Value>) -> Errors {
    let (mut sizes, mut not_given) = (Vec::new(), 0);
    for value in values {
        match value.error {
            Some(error) => sizes.push(error.abs()),
            None => not_given += 1,
        }
    }
    sizes.sort_by(f64::total_cmp);
    let at = |share: f64| sizes.get((share * sizes.len() as f64) as usize).or(sizes.last()).copied();
    let at = |share: f64| at(share).unwrap_or(0.0);
    Errors { given: sizes.len(), not_given, median: at(0.5), most: at(0.95), largest: at(1.0) }
}

/// How many errors lie within their sigmas.
pub fn coverage<'a>(values: impl Iterator<Item = &'a Value>) -> Coverage {
    let over: Vec<f64> = values.filter_map(|v| Some(v.error?.abs() / v.sigma?)).collect();
    let share = |k: f64| over.iter().filter(|o| **o <= k).count() as f64 / over.len().max(1) as f64;
    Coverage { count: over.len(), one: share(1.0), two: share(2.0) }
}

/// Root mean square of error over bound; None without any.
pub fn rms_over_bound<'a>(values: impl Iterator<Item = &'a Value>) -> Option<f64> {
    let squares: Vec<f64> = values.filter_map(|v| Some((v.error? / v.bound?).powi(2))).collect();
    (!squares.is_empty()).then(|| (squares.iter().sum::<f64>() / squares.len() as f64).sqrt())
}

/// All cases of a run.
#[derive(Debug, Clone, Default)]
pub struct Tally {
    /// In the order of their seeds.
    pub cases: Vec<Case>,
}

impl Tally {
    /// Cases with this kind of verdict.
    pub fn count(&self, wanted: impl Fn(&Verdict) -> bool) -> usize {
        self.cases.iter().filter(|c| wanted(&c.judgement.verdict)).count()
    }

    /// Cases that are right.
    pub fn right(&self) -> usize {
        self.count(|v| *v == Verdict::Right)
    }

    /// Every value of a kind, of round tubes, of oval ones, or (None) of all.
    pub fn values(&self, kind: Kind, round: Option<bool>) -> impl Iterator<Item = &Value> {
        let cases = self.cases.iter().filter(move |c| round.is_none_or(|r| r == c.round));
        cases.flat_map(|c| &c.judgement.values).filter(move |v| v.kind == kind)
    }

    /// Median time of a case.
    pub fn median_ms(&self) -> f64 {
        let mut times: Vec<f64> = self.cases.iter().map(|c| c.elapsed_ms).collect();
        times.sort_by(f64::total_cmp);
        times.get(times.len() / 2).copied().unwrap_or(0.0)
    }

    /// What falls short of the set's targets; nothing when they are met.
    pub fn misses(&self, set: Set) -> Vec<String> {
        let mut misses = Vec::new();
        let (right, wanted) = (self.right(), self.cases.len() - self.cases.len() / set.one_wrong_in());
        if right < wanted {
            misses.push(format!("{right} right, wanted {wanted}"));
        }
        let silent = self.count(|v| *v == Verdict::SilentlyWrong);
        if silent > 0 {
            misses.push(format!("{silent} silently wrong, wanted none"));
        }
        for kind in Kind::ALL {
            if set.has_bound_target(kind)
                && let Some(over) =
                    rms_over_bound(self.values(kind, Some(true))).filter(|o| *o > MOST_OVER_BOUND)
            {
                misses.push(format!("{} {over:.2} over its bound, wanted {MOST_OVER_BOUND}", kind.name()));
            }
            let Coverage { count, one, two } = coverage(self.values(kind, None));
            let (ones, twos) = set.coverage_target();
            if count >= ENOUGH_VALUES && !(ones.contains(&one) && twos.contains(&two)) {
                let (one, two) = (100.0 * one, 100.0 * two);
                misses.push(format!("{}: {one:.1} % within one sigma, {two:.1} % within two", kind.name()));
            }
        }
        misses
    }
}
