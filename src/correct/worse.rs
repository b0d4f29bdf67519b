//! Stop after worse twice: two tubes in a row, bent with corrected tables, that are clearly worse than the best one before them.
//!
//! Then the machine does something else than is believed of it (a sign, a row, a spring-back correction of its own), and one
//! correction more would make it worse again. Angles and planes count; feeds do not, since they slip.

use super::estimate::{BEND_SCATTER_RAD, TUBE_SCATTER};
use super::replay::{Replay, Used};
use super::rotations::AXIS_SCATTER_RAD;
use super::verdict::{Code, Reason};
use crate::inspect::{Known, rotation};
use crate::tube::{CommandTable, Nominal, Tolerance, wrap_angle};

/// By so much must the root mean square error grow, in sigmas of a tube's scatter and its scan together: chance does not do that twice.
const CLEARLY: f64 = 3.0;

/// The last good table, and why to go back to it.
pub fn worse_twice(nominal: &Nominal, replay: &Replay) -> Option<(CommandTable, Reason)> {
    let [earlier @ .., before, newest] = replay.used.as_slice() else { return None };
    let errors = |used: &Used| rms(&off(nominal, used));
    let best = earlier.iter().min_by(|a, b| errors(a).total_cmp(&errors(b)))?;
    let is_worse = |tube: &Used| {
        let (own, of_best) = shared(&off(nominal, tube), &off(nominal, best));
        tube.commanded != best.commanded && farthest(&own).1 > 1.0 && rms(&own) - rms(&of_best) > CLEARLY
    };
    if !is_worse(before) || !is_worse(newest) {
        return None;
    }
    let said = |used: &Used| described(&off(nominal, used), &nominal.tolerance);
    let text = format!(
        "two tubes in a row came out worse than part {} before them, though the table was corrected: now {}, then {}; the machine \
         does not do what the table says (sign of a column, order of rows, a spring-back correction of its own?). The table \
         proposed is the one that part {} of {} was bent with: approve it to go back, and look at the machine before the next correction",
        best.number,
        said(newest),
        said(best),
        best.number,
        nominal.name
    );
    Some((best.commanded.clone(), Reason::new(Code::WorseTwice, text)))
}

/// One value of a tube against the part's.
#[derive(Clone, Copy)]
struct Off {
    /// As a share of the tolerance.
    share: f64,
    /// With all that may make the next tube differ.
    known: Known,
}

/// Angles, then rotations; none where a value was rejected or not seen.
fn off(nominal: &Nominal, used: &Used) -> Vec<Option<Off>> {
    let Tolerance { angle_rad, rotation_rad, .. } = nominal.tolerance;
    let bends = || nominal.lra.bends.iter().zip(&used.measured.bends).enumerate();
    let angles = bends().map(|(i, (wanted, seen))| {
        let sprung = TUBE_SCATTER * (used.commanded.bends[i].angle_rad - seen.angle_rad);
        let sigma = seen.angle_sigma_rad.hypot(BEND_SCATTER_RAD).hypot(sprung);
        let value = seen.angle_rad - wanted.angle_rad;
        let heard = !used.outliers.contains(&i);
        heard.then_some(Off { share: value / angle_rad, known: Known { value, sigma } })
    });
    let turns = bends().map(|(i, (wanted, _))| {
        let seen = rotation(&used.measured, i).filter(|r| i > 0 && r.sigma <= rotation_rad / 2.0)?;
        let value = wrap_angle(seen.value - wanted.rotation_rad);
        let known = Known { value, sigma: seen.sigma.hypot(AXIS_SCATTER_RAD) };
        Some(Off { share: value / rotation_rad, known })
    });
    angles.chain(turns).collect()
}

/// What is known of both.
fn shared(a: &[Option<Off>], b: &[Option<Off>]) -> (Vec<Option<Off>>, Vec<Option<Off>>) {
    let both = |a: &[Option<Off>], b: &[Option<Off>]| {
        a.iter().zip(b).map(|(a, b)| a.filter(|_| b.is_some())).collect()
    };
    (both(a, b), both(b, a))
}

/// Root mean square, in sigmas.
fn rms(off: &[Option<Off>]) -> f64 {
    let squares: Vec<f64> = off.iter().flatten().map(|o| (o.known.value / o.known.sigma).powi(2)).collect();
    (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt()
}

/// The value that is farthest out, and its share of the tolerance.
fn farthest(off: &[Option<Off>]) -> (usize, f64) {
    let shares = off.iter().enumerate().filter_map(|(k, off)| Some((k, off.as_ref()?.share.abs())));
    shares.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((0, 0.0))
}

fn described(off: &[Option<Off>], tolerance: &Tolerance) -> String {
    let (k, share) = farthest(off);
    let bends = off.len() / 2;
    let (what, allowed) =
        if k < bends { ("angle", tolerance.angle_rad) } else { ("rotation", tolerance.rotation_rad) };
    let bend = k % bends.max(1) + 1;
    format!("{what} {bend} is {:.2} degrees off", (share * allowed).to_degrees())
}
