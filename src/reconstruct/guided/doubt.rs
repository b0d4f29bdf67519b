//! Whether the nominal's structure, fitted to the scan, can be believed without asking the free search.

use nalgebra::Point3;

use super::super::evidence::Joint;
use super::super::likeness::{is_formed, rows};
use super::super::model::{Parameter, TubeModel};
use super::super::moves::{split, with_bend};
use super::super::search::{ABOVE_PASSES, JOINT_GAIN};
use super::super::stripes;
use super::super::whole::Whole;
use super::{AS_IT_IS, FULLY, Guided, SIGMAS, fitted};

/// A vertex of the spine's polygon this far from the fitted centre line is not explained by it, in tube radii; and how
/// many in a row may be so.
const OFF_RADII: f64 = 0.25;
const MOST_OFF: usize = 3;

/// Sections that scatter this much more than their points say are not the tube's, unless the passes disagree: so many times
/// what that makes of a section's points.
const MOST_CORRELATION: f64 = 25.0;
const PASSES_CORRELATION: f64 = 5.0;

/// A joint that takes away such a share of all misfit is tried whatever the scatter (more than in `search`: each doubt costs a
/// free search).
const EXPLAINED: f64 = 0.2;

/// A joint worth so many times what makes it looked at is more than one bend's.
const MOST_GAIN: f64 = 10.0;

/// Forming and the die's wear change a CLR by less than this share of it.
const DIE_SHARE: f64 = 0.2;

/// An angle less certain than this is not measured by the nominal's structure; the free search is asked.
const MAX_ANGLE_SIGMA_RAD: f64 = 5.0 * std::f64::consts::PI / 180.0;

impl Guided {
    /// Whether all of the spine's polygon lies on the fitted centre line.
    pub(super) fn explains(&self, polygon: &[Point3<f64>]) -> bool {
        // The ends' lengths are not fitted.
        let mut model = self.best.model.clone();
        let beyond = 10.0 * model.tube_radius_mm;
        model.start *= nalgebra::Translation3::new(-beyond, 0.0, 0.0);
        model.lra.bends.iter_mut().take(1).for_each(|b| b.length_mm += beyond);
        model.lra.last_length_mm += beyond;
        let spine = model.spine();
        let mut run = 0;
        polygon.iter().all(|p| {
            let off = spine.closest(p).distance_mm > OFF_RADII * model.tube_radius_mm;
            run = if off { run + 1 } else { 0 };
            run <= MOST_OFF
        })
    }

    /// Whether forming may have made this of the nominal.
    pub(super) fn is_formed_of_the_nominal(&self) -> bool {
        let mut found = rows(&self.best.model.lra);
        let unknown = f64::INFINITY;
        for (i, row) in found.iter_mut().enumerate() {
            row.angle_sigma_rad = self.angle_sigma_rad(i);
            row.length_sigma_mm = self.sigma(Parameter::Length(i)).unwrap_or(unknown);
            row.rotation_sigma_rad = self.sigma(Parameter::Rotation(i)).unwrap_or(unknown);
        }
        is_formed(&found, &rows(&self.part), self.best.model.tube_radius_mm)
    }

    /// Whether nothing speaks for asking the free search.
    pub(super) fn is_sure(&self, polygon: &[Point3<f64>], whole: &Whole) -> bool {
        // A walk through the points that is not always needed.
        let passes_mm = || stripes::disagreement_mm(whole, &self.best.model, self.line.noise_mm);
        !self.is_scattered(&passes_mm)
            && self.is_determined()
            && self.is_formed_of_the_nominal()
            && self.explains(polygon)
            && self.is_of_its_dies()
            && !self.lacks_a_bend(&passes_mm)
    }

    /// Whether every angle is measured.
    pub(super) fn is_determined(&self) -> bool {
        (0..self.part.bends.len()).all(|i| self.angle_sigma_rad(i) <= MAX_ANGLE_SIGMA_RAD)
    }

    /// Whether the sections scatter more about the tube than their points, and what the passes disagree, say.
    fn is_scattered(&self, passes_mm: &dyn Fn() -> f64) -> bool {
        if self.correlation <= MOST_CORRELATION {
            return false;
        }
        let each = self.line.count / (self.line.places() as f64).max(1.0);
        let passes = each * (passes_mm() / self.line.noise_mm).powi(2);
        self.correlation > PASSES_CORRELATION * passes
    }

    /// Whether a bend more would explain the scan better, or what the residuals say is too much for one: tried where the
    /// free search would try one, and judged by what it leaves.
    fn lacks_a_bend(&self, passes_mm: &dyn Fn() -> f64) -> bool {
        let (model, line) = (&self.best.model, &self.line);
        let mut joints = self.solved.joints(line, model, &self.best.parameters, line.noise_mm);
        let gain = JOINT_GAIN * self.correlation;
        let price = self.best.parameters.len() as f64 * (line.count / self.correlation).max(2.0).ln();
        let misfit = (self.best.score - price) * self.correlation;
        joints.retain(|j| j.gain > gain.min(EXPLAINED * misfit));
        joints.sort_by(|a, b| b.gain.total_cmp(&a.gain));
        if joints.first().is_some_and(|j| j.gain > MOST_GAIN * gain) {
            return true;
        }
        let mut tried: Vec<&Joint> = Vec::new();
        for joint in &joints {
            let near = |other: &&Joint| (other.at_mm - joint.at_mm).abs() < 2.0 * model.tube_radius_mm;
            if !tried.iter().any(near) {
                tried.push(joint);
            }
        }
        let more = tried.iter().flat_map(|j| [with_bend(model, j), split(model, j)].concat());
        // Its place is the best of many.
        let place = 2.0 * (line.places() as f64).ln();
        let is_better = |more: TubeModel| {
            let more = fitted(line, more, self.prior, self.correlation, FULLY).model;
            let correlation = line.correlation(&more).min(self.correlation);
            let judged = |m: &TubeModel| fitted(line, m.clone(), self.prior, correlation, AS_IT_IS).score;
            judged(&more) + place < judged(model) && line.apart_mm(model, &more) > ABOVE_PASSES * passes_mm()
        };
        more.into_iter().any(is_better)
    }

    /// Whether every CLR is about the nominal's: a bend much wider may be two.
    fn is_of_its_dies(&self) -> bool {
        let pairs = self.best.model.lra.bends.iter().zip(&self.part.bends).enumerate();
        pairs.into_iter().all(|(i, (found, part))| {
            let sigma_mm = self.sigma(Parameter::BendRadius(i)).unwrap_or(0.0);
            (found.radius_mm - part.radius_mm).abs() < DIE_SHARE * part.radius_mm + SIGMAS * sigma_mm
        })
    }
}
