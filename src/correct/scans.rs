//! Several scans of one tube become one measurement, better known than each.
//!
//! Between `history` and `replay`. Values are weighed with 1 / sigma^2 (scans are taken to err independently); a single one that
//! fits none of the others is left out; scans that differ in more than a third of the angles are of different tubes after all.

use crate::inspect::Known;
use crate::tube::{MeasuredTube, wrap_angle};

/// Values that are farther apart than so many sigmas are not of the same thing.
const APART: f64 = 5.0;

/// What several scans say together.
#[derive(Debug, Clone, PartialEq)]
pub struct Fused {
    /// Each value from the scans that agree on it.
    pub measured: MeasuredTube,
    /// How many scans agree on each bend's angle.
    pub agreed: Vec<usize>,
}

impl Fused {
    /// Of one scan.
    pub fn single(measured: MeasuredTube) -> Fused {
        Fused { agreed: vec![1; measured.bends.len()], measured }
    }
}

/// One tube's scans, all in the same direction, the newest last. None when they are not of the same tube.
pub fn fused(scans: &[MeasuredTube]) -> Option<Fused> {
    let mut out = scans.last()?.clone();
    let mut agreed = Vec::new();
    let blend = |of: &dyn Fn(&MeasuredTube) -> Option<Known>| {
        let known: Vec<Known> = scans.iter().filter_map(of).collect();
        let agreeing = agreeing(&known);
        (mean(&agreeing), agreeing.len())
    };
    for i in 0..out.bends.len() {
        let bend = |scan: &MeasuredTube| scan.bends.get(i).copied();
        let (angle, scans_agreed) =
            blend(&|s| bend(s).map(|b| Known { value: b.angle_rad, sigma: b.angle_sigma_rad }));
        let (length, _) = blend(&|s| bend(s).and_then(|b| known(b.length_mm, b.length_sigma_mm)));
        let (radius, _) = blend(&|s| bend(s).and_then(|b| known(b.radius_mm, b.radius_sigma_mm)));
        let near_rad = out.bends[i].rotation_rad.unwrap_or(0.0);
        let (turn, _) = blend(&|s| {
            let b = bend(s)?;
            let turn = known(b.rotation_rad, b.rotation_sigma_rad)?;
            Some(Known { value: near_rad + wrap_angle(turn.value - near_rad), ..turn })
        });
        agreed.push(scans_agreed);
        let own = &mut out.bends[i];
        if let Some(angle) = angle {
            (own.angle_rad, own.angle_sigma_rad) = (angle.value, angle.sigma);
        }
        put(length, &mut own.length_mm, &mut own.length_sigma_mm);
        put(radius, &mut own.radius_mm, &mut own.radius_sigma_mm);
        if i > 0 {
            put(turn, &mut own.rotation_rad, &mut own.rotation_sigma_rad);
        }
    }
    let (last, _) = blend(&|s| known(s.last_length_mm, s.last_length_sigma_mm));
    put(last, &mut out.last_length_mm, &mut out.last_length_sigma_mm);
    let corners = out.intersection_mm.len();
    out.intersection_sigma_mm.resize(corners, None);
    for j in 0..corners {
        let (corner, _) = blend(&|s| {
            let sigma = s.intersection_sigma_mm.get(j).copied().flatten();
            known(s.intersection_mm.get(j).copied().flatten(), sigma)
        });
        put(corner, &mut out.intersection_mm[j], &mut out.intersection_sigma_mm[j]);
    }
    let odd = agreed.iter().filter(|agreed| **agreed < scans.len()).count();
    (3 * odd <= out.bends.len().max(3)).then_some(Fused { measured: out, agreed })
}

/// The same measurement with the sigmas that one scan more would leave, if it said the same.
pub fn with_one_more(measured: &MeasuredTube, scans: usize) -> MeasuredTube {
    let factor = (scans as f64 / (scans as f64 + 1.0)).sqrt();
    let shrink = |sigma: &mut Option<f64>| *sigma = sigma.map(|s| s * factor);
    let mut out = measured.clone();
    for bend in &mut out.bends {
        bend.angle_sigma_rad *= factor;
        shrink(&mut bend.length_sigma_mm);
        shrink(&mut bend.rotation_sigma_rad);
        shrink(&mut bend.radius_sigma_mm);
    }
    out.intersection_sigma_mm.iter_mut().for_each(shrink);
    shrink(&mut out.last_length_sigma_mm);
    out
}

/// A value without its sigma (other programs' files) cannot be weighed against others.
fn known(value: Option<f64>, sigma: Option<f64>) -> Option<Known> {
    Some(Known { value: value?, sigma: sigma? })
}

/// Where nothing could be weighed the newest scan's stays.
fn put(found: Option<Known>, value: &mut Option<f64>, sigma: &mut Option<f64>) {
    if let Some(found) = found {
        (*value, *sigma) = (Some(found.value), Some(found.sigma));
    }
}

/// The largest number that agree with one of them; of equal numbers those with the newest.
fn agreeing(all: &[Known]) -> Vec<Known> {
    let with = |one: &Known| -> Vec<Known> {
        let near = |k: &&Known| (k.value - one.value).abs() <= APART * k.sigma.hypot(one.sigma);
        all.iter().filter(near).copied().collect()
    };
    all.iter().map(with).max_by_key(Vec::len).unwrap_or_default()
}

fn mean(all: &[Known]) -> Option<Known> {
    // A value said to be exact is taken as such.
    if let Some(exact) = all.iter().rev().find(|k| k.sigma <= 0.0) {
        return Some(*exact);
    }
    let weight: f64 = all.iter().map(|k| k.sigma.powi(-2)).sum();
    let value = all.iter().map(|k| k.value * k.sigma.powi(-2)).sum::<f64>() / weight;
    (weight > 0.0).then(|| Known { value, sigma: weight.sqrt().recip() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::{Bend, Lra};

    fn scan(angles_deg: [f64; 3], feed_mm: f64) -> MeasuredTube {
        let bend = |angle: f64| Bend {
            length_mm: feed_mm,
            rotation_rad: 3.1,
            angle_rad: angle.to_radians(),
            radius_mm: 50.0,
        };
        let lra = Lra { bends: angles_deg.map(bend).to_vec(), last_length_mm: 80.0 };
        let mut out = MeasuredTube::exact(&lra, 12.7);
        for b in &mut out.bends {
            b.angle_sigma_rad = 0.05_f64.to_radians();
            b.rotation_sigma_rad = Some(0.002);
            (b.length_sigma_mm, b.radius_sigma_mm) = (Some(0.04), Some(0.3));
        }
        out.intersection_sigma_mm = vec![Some(0.04); 4];
        out.last_length_sigma_mm = Some(0.04);
        out
    }

    #[test]
    fn two_scans_are_known_better_by_the_root_of_two() {
        let out =
            fused(&[scan([90.0, 45.0, 30.0], 100.0), scan([90.1, 45.0, 30.0], 100.1)]).unwrap().measured;
        assert!((out.bends[0].angle_rad.to_degrees() - 90.05).abs() < 1e-9);
        let sigma = out.bends[0].angle_sigma_rad.to_degrees();
        assert!((sigma - 0.05 / 2_f64.sqrt()).abs() < 1e-9, "{sigma}");
        assert!((out.bends[1].length_mm.unwrap() - 100.05).abs() < 1e-9);
    }

    #[test]
    fn turns_on_both_sides_of_half_a_turn_have_their_mean_there() {
        let (mut a, mut b) = (scan([90.0, 45.0, 30.0], 100.0), scan([90.0, 45.0, 30.0], 100.0));
        a.bends[1].rotation_rad = Some(std::f64::consts::PI - 0.001);
        b.bends[1].rotation_rad = Some(-std::f64::consts::PI + 0.001);
        let turn = fused(&[a, b]).unwrap().measured.bends[1].rotation_rad.unwrap();
        assert!(wrap_angle(turn - std::f64::consts::PI).abs() < 1e-9, "{turn}");
    }

    /// Found: a turn that came without a sigma was known to 0.1 radians afterwards, and never corrected again.
    #[test]
    fn values_without_a_sigma_stay_the_newest_ones() {
        let (mut a, mut b) = (scan([90.0, 45.0, 30.0], 100.0), scan([90.0, 45.0, 30.0], 100.2));
        for measured in [&mut a, &mut b] {
            measured.bends.iter_mut().for_each(|bend| {
                (bend.rotation_sigma_rad, bend.length_sigma_mm) = (None, None);
            });
            measured.intersection_sigma_mm = Vec::new();
        }
        let out = fused(&[a, b.clone()]).unwrap().measured;
        assert_eq!(out.bends[1].rotation_sigma_rad, None);
        assert_eq!((out.bends[1].length_mm, out.bends[1].length_sigma_mm), (b.bends[1].length_mm, None));
        assert_eq!(out.intersection_mm, b.intersection_mm);
    }

    #[test]
    fn one_gross_error_is_left_out_and_the_newest_settles_it_between_two() {
        let (right, wrong) = (scan([90.0, 45.0, 30.0], 100.0), scan([90.0, 48.0, 30.0], 100.0));
        for scans in [vec![wrong.clone(), right.clone()], vec![right.clone(), wrong, right]] {
            let out = fused(&scans).unwrap();
            assert!((out.measured.bends[1].angle_rad.to_degrees() - 45.0).abs() < 1e-9);
            assert_eq!(out.agreed, [scans.len(), scans.len() - 1, scans.len()]);
        }
    }

    #[test]
    fn scans_that_differ_in_several_angles_are_of_different_tubes() {
        assert_eq!(fused(&[scan([90.0, 45.0, 30.0], 100.0), scan([92.0, 47.0, 30.0], 100.0)]), None);
        assert_eq!(fused(&[]), None);
    }
}
