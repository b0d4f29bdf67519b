//! The whole tube: where values cannot be what they should (a limit, a clamp, the machine's steps), the others make up for it.
//!
//! Each value has its best and a range: what the limits leave, and no farther from its best than its own tolerance (half of it
//! for an angle, whose other half is for what scatters). Wanted is the least sum of squares of all that is
//! accepted on: the check points after the part's alignment over the envelope, each value over its own tolerance.
//! A tube that is accepted comes before one that costs less.
//! Whatever the next tube scatters by in it anyway counts with the tolerance, so that nothing is moved for what nobody will see.

use nalgebra::{DMatrix, DVector};

use super::next_tube::NextTube;
use super::plan::{self, Limits};
use super::replay::{Model, Used};
use super::rounding::{Choice, Quadratic, choose, polish};
use super::steps::{is_other_rounding, rounded, taken_from, with};
use super::values::Value;
use crate::tube::{CommandTable, Nominal};

/// What is off by less than this share of its tolerance is not worth another table.
const WORTH: f64 = 0.1;

/// What a shape depends on.
#[derive(Debug, Clone, Copy)]
pub struct Case<'a> {
    /// What is believed.
    pub model: &'a Model,
    /// The part.
    pub nominal: &'a Nominal,
    /// The part that is corrected after; none for the first piece.
    pub newest: Option<&'a Used>,
    /// What a correction may do.
    pub limits: &'a Limits,
}

/// The table that makes the best tube. The planned one itself where all is as good as it can be.
pub fn shaped(case: &Case, planned: CommandTable) -> CommandTable {
    if !plan::violations(&planned, case.nominal, case.limits).is_empty() {
        return planned; // held for a person, who is told the values
    }
    case.best(&planned).unwrap_or(planned)
}

impl Case<'_> {
    /// What the machine makes of each value for itself: the limits' best, rounded along the table as the gate does.
    pub fn each_for_itself(&self, table: &CommandTable) -> CommandTable {
        rounded(&self.aims(table), &self.limits.machine)
    }

    /// Each value the best that limits let it be; what is not to be changed is `table`'s.
    pub fn aims(&self, table: &CommandTable) -> CommandTable {
        with(table, self.values(table).iter().map(Value::aim))
    }

    /// The tube that the machine makes of a table.
    pub fn next_tube(&self, table: &CommandTable) -> Option<NextTube> {
        NextTube::new(self.model, self.nominal, &rounded(table, &self.limits.machine))
    }

    /// The tube of the limits' best values on a machine without steps.
    pub fn next_tube_within_limits(&self, table: &CommandTable) -> Option<NextTube> {
        NextTube::new(self.model, self.nominal, &self.aims(table))
    }

    /// Whether this is the shortest feed that the machine makes before a bend (from 0).
    pub fn is_shortest(&self, bend: usize, length_mm: f64) -> bool {
        length_mm == plan::shortest_feed(&self.limits.machine, bend)
    }

    /// Whether the machine's rounding of each value for itself is worth a thought, or a limit is.
    pub fn matters(&self, each: &NextTube) -> bool {
        each.share(self.nominal) > WORTH
    }

    fn best(&self, planned: &CommandTable) -> Option<CommandTable> {
        let values = self.values(planned);
        let aims = with(planned, values.iter().map(Value::aim));
        let each = rounded(&aims, &self.limits.machine);
        let by_itself = self.next_tube(&each)?;
        if !self.matters(&by_itself) {
            return None;
        }
        let (cost, weights) = self.cost(&aims)?;
        let start: Vec<f64> = values.iter().map(Value::aim).collect();
        let share = |tube: &NextTube| tube.share(self.nominal);
        let mut found = vec![(each, by_itself)];
        // Angles where they are accepted, if the machine has steps there; else wherever the check points are nearest.
        for within_tolerance in [true, false] {
            let choices: Vec<Choice> = values.iter().map(|v| v.choice(within_tolerance)).collect();
            let chosen = polish(&cost, &start, &choices, choose(&cost, &start, &choices));
            let table = with(planned, chosen.into_iter());
            let tube = self.next_tube(&table)?;
            found.push((table, tube));
            if found.iter().any(|(_, tube)| share(tube) <= 1.0) {
                break;
            }
        }
        let price = |tube: &NextTube| weights.cost(tube, self.nominal);
        let order = |a: &NextTube, b: &NextTube| {
            (share(a) > 1.0).cmp(&(share(b) > 1.0)).then(price(a).total_cmp(&price(b)))
        };
        let (table, tube) = found.into_iter().min_by(|a, b| order(&a.1, &b.1))?;
        let Some(newest) = self.newest else { return Some(table) };
        let in_force = &newest.commanded;
        let gain = share(&self.next_tube(in_force)?) - share(&tube);
        if gain < WORTH && is_other_rounding(&table, in_force, &self.limits.machine) {
            return Some(in_force.clone());
        }
        Some(taken_from(in_force, &table))
    }

    /// The cost around a table, and how it is counted.
    pub fn cost(&self, aims: &CommandTable) -> Option<(Quadratic, Weights)> {
        let tube = NextTube::new(self.model, self.nominal, aims)?;
        let moves = tube.overlay.moves();
        let sigmas = tube.sigmas(self.model, aims);
        let weights = Weights::new(self, &sigmas, &tube.point_sigmas(&moves, &sigmas));
        let gains = DVector::from_vec(tube.gains(self.model, aims));
        let mut per_value = moves;
        per_value.column_iter_mut().zip(gains.iter()).for_each(|(mut column, gain)| column *= *gain);
        let mut weighted = per_value.clone();
        weighted.row_iter_mut().enumerate().for_each(|(r, mut row)| row *= weights.points[r / 3]);
        let off = DVector::from_iterator(weighted.nrows(), tube.overlay.off_mm.iter().flatten().copied());
        let own = gains.map_with_location(|k, _, gain| gain * weights.own[k]);
        let own_off = DVector::from_vec(tube.own_off(self.nominal));
        Some((
            Quadratic {
                curvature: per_value.tr_mul(&weighted) + DMatrix::from_diagonal(&own.component_mul(&gains)),
                slope: weighted.tr_mul(&off) + own.component_mul(&own_off),
            },
            weights,
        ))
    }
}

/// How each deviation counts: one over tolerance and scatter squared.
#[derive(Debug, Clone)]
pub struct Weights {
    points: Vec<f64>,
    own: Vec<f64>,
}

impl Weights {
    fn new(case: &Case, sigmas: &[f64], point_sigmas: &[f64]) -> Weights {
        let weight = |tolerance: f64, sigma: f64| (tolerance.powi(2) + sigma.powi(2)).recip();
        let own = sigmas.iter().enumerate().map(|(k, s)| weight(own_tolerance(case, k), *s));
        let points = point_sigmas.iter().map(|s| weight(case.nominal.tolerance.envelope_mm, *s));
        Weights { points: points.collect(), own: own.collect() }
    }

    /// Of a tube: the sum of squares that is to be least.
    pub fn cost(&self, tube: &NextTube, nominal: &Nominal) -> f64 {
        let points = self.points.iter().zip(&tube.overlay.off_mm).map(|(w, off)| w * off.norm_squared());
        let own = self.own.iter().zip(tube.own_off(nominal)).map(|(w, off)| w * off.powi(2));
        points.chain(own).sum()
    }
}

/// Of a value in the order length, rotation, angle; one that the machine's steps cannot keep counts over a step.
fn own_tolerance(case: &Case, value: usize) -> f64 {
    let (t, machine) = (&case.nominal.tolerance, &case.limits.machine);
    let turn = machine.angle_resolution_rad;
    let tolerance = [t.length_mm, t.rotation_rad, t.angle_rad][value % 3];
    tolerance.max([machine.length_resolution_mm, turn, turn][value % 3])
}
