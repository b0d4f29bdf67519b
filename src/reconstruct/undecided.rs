//! What a decision that the data hardly makes does to the values: one CLR or one each, two tubes that differ where bends the
//! other way meet, of which one had to be taken.
//!
//! Beside `structure`, for the sigmas of `finish`. Of two structures whose information criteria differ by d the better is
//! the right one with probability 1 / (1 + exp(-d / 2)); a value that differs between them scatters by that (model
//! averaging: J. Hoeting et al., Statistical Science 1999, section 1).

use nalgebra::{DMatrix, DVector};

use super::model::{Parameter, TubeModel};

/// Ways in which the values may be off together because the other structure may be right, each by one standard deviation. The CLR of
/// a single bend is told even where the tube has one for all.
pub type Undecided = Vec<Vec<(Parameter, f64)>>;

/// A tube with a CLR for every bend: what speaks for one CLR instead, and how sure its values are.
pub struct Own<'a> {
    /// The tube.
    pub model: &'a TubeModel,
    /// By how much one CLR for all is better, as twice the logarithm of how many times likelier it is.
    pub gain: f64,
    /// The values that `covariance` is of.
    pub parameters: &'a [Parameter],
    /// Covariance of its values.
    pub covariance: &'a DMatrix<f64>,
}

/// Ways in which the values of the tube with one CLR may be off because each bend may have its own: by how much both tubes differ,
/// and how far each bend's own CLR, with all that follows it, is open if it has one. None for tubes with different numbers of bends:
/// there the count itself is the question.
pub fn between(one: &TubeModel, other: &Own) -> Undecided {
    let (own, others) = (&one.lra.bends, &other.model.lra.bends);
    if own.len() != others.len() || own.is_empty() {
        return Undecided::new();
    }
    let right = 1.0 / (1.0 + (-0.5 * other.gain).exp());
    let (share, wrong) = ((right * (1.0 - right)).sqrt(), (1.0 - right).sqrt());
    let slide_mm = own[0].length_mm - others[0].length_mm;
    let apart = one.start.inverse() * other.model.start;
    let (shift, turn) = (apart.translation.vector, apart.rotation.scaled_axis());
    let off = |p: &Parameter| match *p {
        // The first bend stays where it is, however far the straight before it reaches.
        Parameter::Pose(0) => shift.x - slide_mm,
        Parameter::Pose(k) if k < 3 => shift[k],
        Parameter::Pose(k) => turn[k - 3],
        Parameter::Length(i) => others[i].length_mm - own[i].length_mm,
        Parameter::Rotation(i) => crate::tube::wrap_angle(others[i].rotation_rad - own[i].rotation_rad),
        Parameter::Angle(i) => others[i].angle_rad - own[i].angle_rad,
        Parameter::BendRadius(i) => others[i].radius_mm - own[i].radius_mm,
        _ => 0.0,
    };
    let mut out = vec![other.model.parameters().into_iter().map(|p| (p, share * off(&p))).collect()];
    for (j, _) in radii(other.parameters) {
        let column = other.covariance.column(j);
        let size = wrong / column[j].max(1e-300).sqrt();
        out.push(other.parameters.iter().zip(&column).map(|(p, c)| (*p, size * c)).collect());
    }
    out
}

/// The CLRs among the values: which value, and of which bend.
pub fn radii(parameters: &[Parameter]) -> impl Iterator<Item = (usize, usize)> + '_ {
    parameters.iter().enumerate().filter_map(|(j, p)| match p {
        Parameter::BendRadius(i) => Some((j, *i)),
        _ => None,
    })
}

/// What still holds after bends were dropped or made one: nothing, since the values that differed are not the same any more.
pub fn of(undecided: Undecided, model: &TubeModel) -> Undecided {
    let angles =
        |way: &[(Parameter, f64)]| way.iter().filter(|(p, _)| matches!(p, Parameter::Angle(_))).count();
    let same = undecided.iter().all(|way| angles(way) == model.lra.bends.len());
    if same { undecided } else { Undecided::new() }
}

/// The covariance with what was not decided.
pub fn widened(
    mut covariance: DMatrix<f64>,
    parameters: &[Parameter],
    undecided: &Undecided,
) -> DMatrix<f64> {
    for way in undecided {
        let off = DVector::from_iterator(parameters.len(), parameters.iter().map(|p| along(way, p)));
        covariance += &off * off.transpose();
    }
    covariance
}

/// By how much the CLR of a bend may be off because of it.
pub fn radius_doubt_mm(undecided: &Undecided, bend: usize) -> f64 {
    let square = |way: &Vec<(Parameter, f64)>| along(way, &Parameter::BendRadius(bend)).powi(2);
    undecided.iter().map(square).sum::<f64>().sqrt()
}

fn along(way: &[(Parameter, f64)], parameter: &Parameter) -> f64 {
    way.iter().find(|(p, _)| p == parameter).map_or(0.0, |(_, off)| *off)
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

    /// By how much the values differ, where the other tube's are known exactly.
    fn flat(one: &TubeModel, model: &TubeModel, gain: f64) -> Vec<(Parameter, f64)> {
        let covariance = DMatrix::zeros(0, 0);
        between(one, &Own { model, gain, parameters: &[], covariance: &covariance })
            .into_iter()
            .flatten()
            .collect()
    }

    #[test]
    fn a_clr_that_may_be_its_bends_own_is_as_open_as_that() {
        let one = TubeModel { common_radius: true, ..tube(2.0, 1.0) };
        let mut model = tube(2.0, 1.0);
        model.lra.bends[1].radius_mm = 23.0;
        let parameters = [Parameter::BendRadius(0), Parameter::BendRadius(1), Parameter::Length(1)];
        let covariance = DMatrix::from_row_slice(3, 3, &[0.01, 0.0, 0.0, 0.0, 16.0, -2.0, 0.0, -2.0, 0.3]);
        let doubts = |gain| {
            let own = Own { model: &model, gain, parameters: &parameters, covariance: &covariance };
            let found = between(&one, &own);
            let wide = widened(DMatrix::zeros(1, 1), &[Parameter::Length(1)], &found);
            (radius_doubt_mm(&found, 0), radius_doubt_mm(&found, 1), wide[(0, 0)])
        };
        let (known, open, length) = doubts(0.0);
        assert!((known - 0.005f64.sqrt()).abs() < 1e-12);
        assert!((open - (8.0f64 + 2.25).sqrt()).abs() < 1e-12);
        assert!((length - 0.125).abs() < 1e-12);
        assert!(doubts(100.0).1 < 1e-6);
    }

    #[test]
    fn a_toss_up_leaves_half_the_difference() {
        let one = TubeModel { common_radius: true, ..tube(2.0, 1.0) };
        let found = flat(&one, &tube(5.0, 0.9), 0.0);
        let off = |p| found.iter().find(|(q, _)| *q == p).map(|(_, off)| *off).unwrap();
        assert!((off(Parameter::Length(1)) - 1.5).abs() < 1e-12);
        assert!((off(Parameter::Angle(0)) + 0.05).abs() < 1e-12);
        let parameters = [Parameter::Angle(0), Parameter::Length(1)];
        let wide = widened(DMatrix::identity(2, 2), &parameters, &vec![found]);
        assert!((wide[(1, 1)] - 3.25).abs() < 1e-12 && (wide[(0, 1)] + 0.075).abs() < 1e-12);
    }

    #[test]
    fn what_is_decided_is_not_widened() {
        let one = TubeModel { common_radius: true, ..tube(2.0, 1.0) };
        let found = flat(&one, &tube(5.0, 0.9), 100.0);
        assert!(found.iter().all(|(_, off)| off.abs() < 1e-9));
        let more = TubeModel::round(Frame::identity(), Lra::default(), 5.0);
        assert!(flat(&one, &more, 0.0).is_empty());
    }

    #[test]
    fn a_start_that_slides_along_the_first_straight_is_no_difference() {
        let one = tube(2.0, 1.0);
        let mut slid = one.clone();
        slid.start *= Frame::translation(7.0, 0.0, 0.0);
        slid.lra.bends[0].length_mm -= 7.0;
        assert!(flat(&one, &slid, 0.0).iter().all(|(_, off)| off.abs() < 1e-12));
    }
}
