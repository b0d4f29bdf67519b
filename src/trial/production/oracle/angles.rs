//! The oracle's angles: a grid over the key's and batch's common scale and over the law (its fixed part, or which curve); for each of
//! these the residuals of the program as a normal distribution.

use std::rc::Rc;

use nalgebra::{DMatrix, DVector};

use super::super::mixups::GROSS_RAD;
use super::{log_normal, normal_middles, normalised};
use crate::sim::forming::law::{Law, elastic_share};
use crate::sim::forming::{World, spread};
use crate::tube::Nominal;

/// Steps of the logarithmic scale, and how far it is looked.
const STEP: f64 = 0.01;
const STEPS: i32 = 130;

/// Fixed parts that are tried.
const FIXED: usize = 15;

/// Sizes of a change that are tried.
const SHIFTS: usize = 15;

/// Possibilities less likely than this are dropped.
const LEAST: f64 = 1e-6;

/// Variance of an angle that says nothing.
const NOTHING: f64 = 1.0;

/// What may happen besides the usual scatter.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Mishaps {
    /// Share of angles measured grossly wrong.
    pub gross: f64,
    /// How likely the tubes change before a part, once in a job, and by how much (sigma of the logarithm of their scale).
    pub shift: (f64, f64),
}

#[derive(Debug, Clone)]
struct Node {
    law: usize,
    log_scale: f64,
    scale: f64,
    /// Whether the tubes have changed.
    changed: bool,
    weight: f64,
    residual: DVector<f64>,
    covariance: DMatrix<f64>,
}

/// The belief.
#[derive(Debug, Clone)]
pub struct Angles {
    world: World,
    part: Nominal,
    /// Of each bend.
    elastic: Vec<f64>,
    laws: Rc<Vec<Law>>,
    nodes: Vec<Node>,
    mishaps: Mishaps,
}

impl Angles {
    /// Before the key's first part.
    pub fn new(world: &World, part: &Nominal, mishaps: Mishaps) -> Angles {
        let laws: Vec<Law> = if world.curves.is_empty() {
            let [least, most] = spread::FIXED_RANGE_RAD;
            let fixed = |sigmas: f64| spread::FIXED_RAD * (spread::FIXED_SIGMA * sigmas).exp();
            let middles = normal_middles(FIXED);
            middles.into_iter().map(|s| Law::Beam { fixed_rad: fixed(s).clamp(least, most) }).collect()
        } else {
            world.curves.iter().cloned().map(Law::Curve).collect()
        };
        let mut out = Angles {
            world: world.clone(),
            part: part.clone(),
            elastic: elastic_shares(part),
            laws: Rc::new(laws),
            nodes: Vec::new(),
            mishaps,
        };
        let variance = spread::KEY.powi(2) + batch_variance();
        out.spread_over(|_, log_scale| log_normal(log_scale, variance).exp());
        out
    }

    /// Fills the grid, the residuals unknown.
    fn spread_over(&mut self, weight: impl Fn(usize, f64) -> f64) {
        let n = self.part.lra.bends.len();
        let covariance = DMatrix::identity(n, n) * self.world.residual_sigma_rad.powi(2);
        let scales = (-STEPS..=STEPS).map(|k| f64::from(k) * STEP);
        let laws = 0..self.laws.len();
        let node = |(law, log_scale): (usize, f64)| Node {
            law,
            log_scale,
            scale: log_scale.exp(),
            changed: false,
            weight: weight(law, log_scale),
            residual: DVector::zeros(n),
            covariance: covariance.clone(),
        };
        self.nodes = laws.flat_map(|law| scales.clone().map(move |s| (law, s))).map(node).collect();
        self.prune();
    }

    /// Another part on the same set-up.
    pub fn new_program(&mut self, part: &Nominal) {
        (self.part, self.elastic) = (part.clone(), elastic_shares(part));
        let n = part.lra.bends.len();
        let covariance = DMatrix::identity(n, n) * self.world.residual_sigma_rad.powi(2);
        for node in &mut self.nodes {
            (node.residual, node.covariance) = (DVector::zeros(n), covariance.clone());
        }
    }

    /// Tubes of another batch: what was learned is the key's only in part.
    pub fn new_batch(&mut self, part: &Nominal) {
        (self.part, self.elastic) = (part.clone(), elastic_shares(part));
        let (key, batch) = (spread::KEY.powi(2), batch_variance());
        let variance = key * batch / (key + batch) + batch;
        let known: Vec<(usize, f64, f64)> =
            self.nodes.iter().map(|n| (n.law, n.log_scale * key / (key + batch), n.weight)).collect();
        self.spread_over(|law, log_scale| {
            let same = known.iter().filter(|(l, ..)| *l == law);
            same.map(|(_, mean, weight)| weight * log_normal(log_scale - mean, variance).exp()).sum()
        });
    }

    fn springback_rad(&self, node: &Node, bend: usize, commanded_rad: f64) -> f64 {
        self.laws[node.law].springback_rad(self.elastic[bend], commanded_rad) * node.scale
    }

    /// Angle to command for a wanted one.
    pub fn command_for(&self, bend: usize, wanted_rad: f64) -> f64 {
        let mut commanded = wanted_rad;
        for _ in 0..40 {
            let back = |n: &Node| n.weight * (self.springback_rad(n, bend, commanded) + n.residual[bend]);
            let next = wanted_rad + self.nodes.iter().map(back).sum::<f64>();
            if (next - commanded).abs() < 1e-9 {
                break;
            }
            commanded = next;
        }
        commanded
    }

    /// Takes one scan in.
    pub fn learn(&mut self, commanded_rad: &[f64], measured: &[(f64, f64)]) {
        self.may_have_shifted();
        let found: Vec<f64> = commanded_rad.iter().zip(measured).map(|(c, (m, _))| c - m).collect();
        let noise: Vec<f64> = measured.iter().map(|(_, sigma)| sigma * sigma).collect();
        let mut nodes = std::mem::take(&mut self.nodes);
        let mut logs = Vec::with_capacity(nodes.len());
        for node in &mut nodes {
            let mean: Vec<f64> =
                (0..found.len()).map(|i| self.springback_rad(node, i, commanded_rad[i])).collect();
            let (noise, log) = self.doubted(node, &mean, &found, &noise);
            logs.push(node.weight.ln() + log + self.update(node, &mean, &found, &noise));
        }
        for (node, weight) in nodes.iter_mut().zip(normalised(&logs)) {
            node.weight = weight;
        }
        self.nodes = nodes;
        self.prune();
    }

    /// The residuals of one possibility; the logarithm of how likely it makes what was found.
    fn update(&self, node: &mut Node, mean: &[f64], found: &[f64], noise: &[f64]) -> f64 {
        let n = found.len();
        let off = DVector::from_fn(n, |i, _| found[i] - mean[i] - node.residual[i]);
        let tube = DVector::from_fn(n, |i, _| self.world.tube_sigma * mean[i]);
        let mut spread = &node.covariance + &tube * tube.transpose();
        for i in 0..n {
            let bend = self.world.bend_sigma_rad + self.world.bend_share * mean[i];
            spread[(i, i)] += bend * bend + noise[i];
        }
        let Some(factor) = spread.cholesky() else { return f64::NEG_INFINITY };
        let solved = factor.solve(&off);
        let log = -0.5 * off.dot(&solved) - factor.l_dirty().diagonal().iter().map(|d| d.ln()).sum::<f64>();
        node.residual += &node.covariance * solved;
        let gain = factor.solve(&node.covariance);
        node.covariance -= &node.covariance * gain;
        log
    }

    /// Angles that are likelier grossly wrong, if this possibility is true, say nothing; and what that costs it in likelihood.
    fn doubted(&self, node: &Node, mean: &[f64], found: &[f64], noise: &[f64]) -> (Vec<f64>, f64) {
        let (mut noise, mut log) = (noise.to_vec(), 0.0);
        let gross = self.mishaps.gross;
        for i in (0..found.len()).filter(|_| gross > 0.0) {
            let bend = self.world.bend_sigma_rad + self.world.bend_share * mean[i];
            let tube = self.world.tube_sigma * mean[i];
            let variance = node.covariance[(i, i)] + bend * bend + tube * tube + noise[i];
            let off = found[i] - mean[i] - node.residual[i];
            let usual = (1.0 - gross).ln() + log_normal(off, variance);
            let wrong = (gross / 2.0).ln() + log_normal(off.abs() - GROSS_RAD, variance);
            if wrong > usual {
                noise[i] += NOTHING;
                log += wrong - log_normal(off, variance + NOTHING);
            }
        }
        (noise, log)
    }

    fn may_have_shifted(&mut self) {
        let (chance, sigma) = self.mishaps.shift;
        if chance == 0.0 {
            return;
        }
        let before: Vec<&Node> = self.nodes.iter().filter(|node| !node.changed).collect();
        let shifted = |by: f64| {
            move |node: &&Node| {
                let (log_scale, weight) = (node.log_scale + by, node.weight * chance / SHIFTS as f64);
                Node { log_scale, scale: log_scale.exp(), changed: true, weight, ..(*node).clone() }
            }
        };
        let each = normal_middles(SHIFTS).into_iter().map(|sigmas| sigma * sigmas);
        let moved: Vec<Node> =
            each.flat_map(|by| before.iter().map(shifted(by)).collect::<Vec<_>>()).collect();
        self.nodes.iter_mut().filter(|node| !node.changed).for_each(|node| node.weight *= 1.0 - chance);
        self.nodes.extend(moved);
    }

    fn prune(&mut self) {
        let most = self.nodes.iter().map(|node| node.weight).fold(0.0, f64::max);
        self.nodes.retain(|node| node.weight > LEAST * most);
        let sum: f64 = self.nodes.iter().map(|node| node.weight).sum();
        self.nodes.iter_mut().for_each(|node| node.weight /= sum);
    }
}

fn elastic_shares(part: &Nominal) -> Vec<f64> {
    part.lra.bends.iter().map(|bend| elastic_share(part, bend.radius_mm)).collect()
}

/// Mean of the squares of what a batch's logarithmic scale scatters by.
fn batch_variance() -> f64 {
    let [from, to] = spread::BATCH;
    (from * from + from * to + to * to) / 3.0
}
