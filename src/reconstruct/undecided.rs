//! What a decision that the data hardly makes does to the values: one CLR or one each, two tubes that differ where bends the
//! other way meet, of which one had to be taken.
//!
//! Beside `structure`, for the sigmas of `finish`. Of two structures whose information criteria differ by d the better is
//! the right one with probability 1 / (1 + exp(-d / 2)); a value that differs between them scatters by that (model
//! averaging: J. Hoeting et al., Statistical Science 1999, section 1).

use nalgebra::{DMatrix, DVector};

use super::model::{Parameter, TubeModel};

/// By how much each value may be off because the other structure may be right: one standard deviation, the same way for all.
pub type Undecided = Vec<(Parameter, f64)>;

/// The values of the tube with one CLR, which scores better by `gain` than the `other` with a CLR each. None for tubes with
/// different numbers of bends: there the count itself is the question.
pub fn between(one: &TubeModel, other: &TubeModel, gain: f64) -> Undecided {
    let (own, others) = (&one.lra.bends, &other.lra.bends);
    if own.len() != others.len() || own.is_empty() {
        return Undecided::new();
    }
    let right = 1.0 / (1.0 + (-0.5 * gain).exp());
    let share = (right * (1.0 - right)).sqrt();
    let slide_mm = own[0].length_mm - others[0].length_mm;
    let apart = one.start.inverse() * other.start;
    let (shift, turn) = (apart.translation.vector, apart.rotation.scaled_axis());
    let off = |p: &Parameter| match *p {
        // The first bend stays where it is, however far the straight before it reaches.
        Parameter::Pose(0) => shift.x - slide_mm,
        Parameter::Pose(k) if k < 3 => shift[k],
        Parameter::Pose(k) => turn[k - 3],
        Parameter::Length(i) => others[i].length_mm - own[i].length_mm,
        Parameter::Rotation(i) => crate::tube::wrap_angle(others[i].rotation_rad - own[i].rotation_rad),
        Parameter::Angle(i) => others[i].angle_rad - own[i].angle_rad,
        _ => 0.0,
    };
    one.parameters().into_iter().map(|p| (p, share * off(&p))).collect()
}

/// What still holds after bends were dropped or made one: nothing, since the values that differed are not the same any more.
pub fn of(undecided: Undecided, model: &TubeModel) -> Undecided {
    let angles = undecided.iter().filter(|(p, _)| matches!(p, Parameter::Angle(_))).count();
    if angles == model.lra.bends.len() { undecided } else { Undecided::new() }
}

/// The covariance with what was not decided.
pub fn widened(covariance: DMatrix<f64>, parameters: &[Parameter], undecided: &Undecided) -> DMatrix<f64> {
    let of = |p: &Parameter| undecided.iter().find(|(q, _)| q == p).map_or(0.0, |(_, off)| *off);
    let off = DVector::from_iterator(parameters.len(), parameters.iter().map(of));
    covariance + &off * off.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tube::{Bend, Frame, Lra};

    fn tube(length_mm: f64, angle_rad: f64) -> TubeModel {
        let bend = Bend { length_mm: 40.0, rotation_rad: 0.0, angle_rad, radius_mm: 20.0 };
        let other = Bend { length_mm, rotation_rad: 3.0, ..bend };
        TubeModel::round(Frame::identity(), Lra { bends: vec![bend, other], last_length_mm: 30.0 }, 5.0)
    }

    #[test]
    fn a_toss_up_leaves_half_the_difference() {
        let one = TubeModel { common_radius: true, ..tube(2.0, 1.0) };
        let found = between(&one, &tube(5.0, 0.9), 0.0);
        let off = |p| found.iter().find(|(q, _)| *q == p).map(|(_, off)| *off).unwrap();
        assert!((off(Parameter::Length(1)) - 1.5).abs() < 1e-12);
        assert!((off(Parameter::Angle(0)) + 0.05).abs() < 1e-12);
        let parameters = [Parameter::Angle(0), Parameter::Length(1)];
        let wide = widened(DMatrix::identity(2, 2), &parameters, &found);
        assert!((wide[(1, 1)] - 3.25).abs() < 1e-12 && (wide[(0, 1)] + 0.075).abs() < 1e-12);
    }

    #[test]
    fn what_is_decided_is_not_widened() {
        let one = TubeModel { common_radius: true, ..tube(2.0, 1.0) };
        let found = between(&one, &tube(5.0, 0.9), 100.0);
        assert!(found.iter().all(|(_, off)| off.abs() < 1e-9));
        let more = TubeModel::round(Frame::identity(), Lra::default(), 5.0);
        assert!(between(&one, &more, 0.0).is_empty());
    }

    #[test]
    fn a_start_that_slides_along_the_first_straight_is_no_difference() {
        let one = tube(2.0, 1.0);
        let mut slid = one.clone();
        slid.start *= Frame::translation(7.0, 0.0, 0.0);
        slid.lra.bends[0].length_mm -= 7.0;
        assert!(between(&one, &slid, 0.0).iter().all(|(_, off)| off.abs() < 1e-12));
    }
}
