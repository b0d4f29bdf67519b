//! The simulated material in the simulated bender: what a table really makes of a tube.
//!
//! Drawn once per key (bender, die, tube, material): how far reality is off the [`law`], the law's fixed part, the split of
//! spring-back between arc and ends, backlash, elongation. Per batch and per tube: scale. Per program: a residual for each
//! bend. Per bend: scatter. The figures are assumptions listed in the field notes ("A believable simulated bender").
//! Nothing here is shared with `correct`, so that the loop is tested on a world that it does not know.

pub mod curves;
pub mod law;

use std::sync::Arc;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Exp1, StandardNormal};

use crate::tube::{Bend, CommandTable, Lra, Nominal};
use curves::Curve;
use law::{Law, elastic_share};

/// A tube as it leaves the machine.
#[derive(Debug, Clone, PartialEq)]
pub struct FormedTube {
    /// True shape: formed angles and radii, straights as they are after spring-back.
    pub lra: Lra,
    /// Per bend: (largest - smallest diameter) / nominal diameter.
    pub ovality: Vec<f64>,
}

/// What kind of bender it is: how spring-back depends on the angle, and how it scatters.
#[derive(Debug, Clone, PartialEq)]
pub struct World {
    /// One of these per key; none: the beam formula.
    pub curves: Vec<Arc<Curve>>,
    /// Logarithmic scatter from tube to tube, common to its bends.
    pub tube_sigma: f64,
    /// Scatter from bend to bend.
    pub bend_sigma_rad: f64,
    /// What comes to it as a share of the spring-back.
    pub bend_share: f64,
    /// What a bend of a program is off by, always (one sigma).
    pub residual_sigma_rad: f64,
}

impl World {
    /// The believable bender.
    pub fn believable() -> World {
        World {
            curves: Vec::new(),
            tube_sigma: 0.015,
            bend_sigma_rad: 0.05 * DEGREE,
            bend_share: 0.008,
            residual_sigma_rad: 0.10 * DEGREE,
        }
    }

    /// A plainer one, to compare with studies: bends scatter by 0.08 degrees, tubes of a batch do not.
    pub fn plain() -> World {
        World { tube_sigma: 0.0, bend_sigma_rad: 0.08 * DEGREE, bend_share: 0.0, ..World::believable() }
    }
}

/// What is drawn for a key is drawn from here.
pub mod spread {
    use super::DEGREE;

    /// Sigma of a key's logarithmic scale.
    pub const KEY: f64 = 0.30;
    /// Sigma of a batch's logarithmic scale: from, to; drawn per key.
    pub const BATCH: [f64; 2] = [0.05, 0.12];
    /// Median of the fixed part of spring-back.
    pub const FIXED_RAD: f64 = 0.7 * DEGREE;
    /// Its logarithmic sigma.
    pub const FIXED_SIGMA: f64 = 0.4;
    /// Its range.
    pub const FIXED_RANGE_RAD: [f64; 2] = [0.3 * DEGREE, 1.5 * DEGREE];
    /// Share of the spring-back that opens the arc.
    pub const IN_ARC: [f64; 2] = [0.5, 0.8];
    /// Backlash.
    pub const BACKLASH_RAD: [f64; 2] = [0.05 * DEGREE, 0.15 * DEGREE];
    /// Small errors of the feed.
    pub const FEED_MM: f64 = 0.08;
    /// How often the clamp slips.
    pub const SLIP_SHARE: f64 = 0.03;
    /// How far on average.
    pub const SLIP_MM: f64 = 0.6;
    /// Scatter of the plane's turn.
    pub const TURN_RAD: f64 = 0.08 * DEGREE;
}

/// What stays while bender, die, tube and material stay.
#[derive(Debug, Clone)]
struct Key {
    /// Real over computed spring-back.
    scale: f64,
    law: Law,
    /// Share of the spring-back that opens the arc; the rest straightens its ends.
    in_arc: f64,
    /// Sigma of a batch's logarithmic scale.
    batch_sigma: f64,
    backlash_rad: f64,
    elongation: f64,
}

/// A bender with a die, forming tubes of one material for one part at a time. Same seed, same tubes.
#[derive(Debug, Clone)]
pub struct Plant {
    rng: ChaCha8Rng,
    world: World,
    part: Nominal,
    key: Key,
    batch_scale: f64,
    /// What each bend of this program is off by, always.
    residual_rad: Vec<f64>,
}

const DEGREE: f64 = std::f64::consts::PI / 180.0;

impl Plant {
    /// Sets the believable bender up for a part: tube, material and die are the part's, everything else is drawn.
    pub fn new(part: &Nominal, seed: u64) -> Plant {
        Plant::of(World::believable(), part, seed)
    }

    /// Sets up a bender of this kind.
    pub fn of(world: World, part: &Nominal, seed: u64) -> Plant {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let scale = (spread::KEY * normal(&mut rng)).exp();
        let fixed_rad = spread::FIXED_RAD * (spread::FIXED_SIGMA * normal(&mut rng)).exp();
        let [least, most] = spread::FIXED_RANGE_RAD;
        let between = |rng: &mut ChaCha8Rng, [from, to]: [f64; 2]| rng.random_range(from..to);
        let key = Key {
            scale,
            law: Law::Beam { fixed_rad: fixed_rad.clamp(least, most) },
            in_arc: between(&mut rng, spread::IN_ARC),
            batch_sigma: between(&mut rng, spread::BATCH),
            backlash_rad: between(&mut rng, spread::BACKLASH_RAD),
            elongation: (0.012 + 0.004 * normal(&mut rng)).max(0.0),
        };
        let residual_rad = Vec::new();
        let mut plant = Plant { rng, world, part: part.clone(), key, batch_scale: 1.0, residual_rad };
        if !plant.world.curves.is_empty() {
            let which = plant.rng.random_range(0..plant.world.curves.len());
            plant.key.law = Law::Curve(Arc::clone(&plant.world.curves[which]));
        }
        plant.new_batch();
        plant.new_program(part);
        plant
    }

    /// The next delivery of tube springs back by another factor.
    pub fn new_batch(&mut self) {
        self.batch_scale = (self.key.batch_sigma * normal(&mut self.rng)).exp();
    }

    /// The tubes spring back by another factor from now on, whatever batch they are said to be of.
    pub fn shift_batch(&mut self, factor: f64) {
        self.batch_scale *= factor;
    }

    /// Another part on the same die, bent from the same tube: new residuals per bend.
    pub fn new_program(&mut self, part: &Nominal) {
        self.part = part.clone();
        let (rng, sigma_rad) = (&mut self.rng, self.world.residual_sigma_rad);
        self.residual_rad = part.lra.bends.iter().map(|_| sigma_rad * normal(rng)).collect();
    }

    /// Bends one tube. Rows beyond the part's own count are bent without a residual.
    pub fn bend(&mut self, commanded: &CommandTable, cut_length_mm: f64) -> FormedTube {
        let tube_scale = (self.world.tube_sigma * normal(&mut self.rng)).exp();
        let mut left_mm = cut_length_mm + 0.2 * normal(&mut self.rng);
        let mut out = FormedTube { lra: Lra::default(), ovality: Vec::new() };
        let (mut carried_mm, mut lag_rad) = (0.0, 0.0);
        for (i, row) in commanded.bends.iter().enumerate() {
            let feed_mm = (row.length_mm + self.feed_error_mm()).max(0.0);
            let (rotation_rad, lag) = self.turned(row.rotation_rad, lag_rad);
            lag_rad = lag;
            let radius_mm = self.part.lra.bends.get(i).map_or(self.part.die_clr_mm, |b| b.radius_mm);
            let springback_rad = self.springback_rad(i, row.angle_rad, radius_mm, tube_scale);
            let bent_mm = radius_mm * row.angle_rad;
            let angle_rad = row.angle_rad - springback_rad;
            let (formed_radius_mm, straightened_mm) =
                opened(radius_mm, row.angle_rad, angle_rad, self.key.in_arc);
            out.lra.bends.push(Bend {
                length_mm: feed_mm + carried_mm + straightened_mm,
                rotation_rad,
                angle_rad,
                radius_mm: formed_radius_mm,
            });
            out.ovality.push(0.025 * 1.5 * self.part.od_mm / radius_mm);
            carried_mm = straightened_mm;
            left_mm -= feed_mm + bent_mm / (1.0 + self.key.elongation);
        }
        out.lra.last_length_mm = (left_mm + carried_mm).max(0.0);
        out
    }

    /// Commanded minus formed angle, at most the whole angle.
    fn springback_rad(&mut self, bend: usize, commanded_rad: f64, radius_mm: f64, tube_scale: f64) -> f64 {
        let share = elastic_share(&self.part, radius_mm);
        let mean = self.key.law.springback_rad(share, commanded_rad);
        let usual = mean * self.key.scale * self.batch_scale * tube_scale;
        let scatter = (self.world.bend_sigma_rad + self.world.bend_share * usual) * normal(&mut self.rng);
        let residual = self.residual_rad.get(bend).copied().unwrap_or(0.0);
        (usual + residual + scatter).clamp(0.0, commanded_rad)
    }

    /// Small errors, and now and then the clamp slips and the feed comes out short.
    fn feed_error_mm(&mut self) -> f64 {
        let slip: f64 =
            if self.rng.random_bool(spread::SLIP_SHARE) { Exp1.sample(&mut self.rng) } else { 0.0 };
        spread::FEED_MM * normal(&mut self.rng) - spread::SLIP_MM * slip
    }

    /// The plane's turn between two bends, and by how much the head now lags: backlash follows the direction
    /// of the last move.
    fn turned(&mut self, commanded_rad: f64, lag_rad: f64) -> (f64, f64) {
        let lag = lag_after(commanded_rad, lag_rad, self.key.backlash_rad);
        (commanded_rad + lag - lag_rad + spread::TURN_RAD * normal(&mut self.rng), lag)
    }
}

/// Backlash follows the direction of the last move.
pub fn lag_after(commanded_rad: f64, lag_rad: f64, backlash_rad: f64) -> f64 {
    if commanded_rad == 0.0 { lag_rad } else { -backlash_rad / 2.0 * commanded_rad.signum() }
}

/// Radius that a bend opens to, and what straightens at each of its ends: part of the spring-back opens the arc, whose length
/// stays; the rest straightens both its ends.
pub fn opened(radius_mm: f64, commanded_rad: f64, formed_rad: f64, in_arc: f64) -> (f64, f64) {
    let bent_mm = radius_mm * commanded_rad;
    let open_rad = (commanded_rad - in_arc * (commanded_rad - formed_rad)).max(1e-9);
    let formed_radius_mm = if bent_mm > 0.0 { bent_mm / open_rad } else { radius_mm };
    (formed_radius_mm, formed_radius_mm * (open_rad - formed_rad).max(0.0) / 2.0)
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(rng)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Document, Materials, parse_part};

    /// Bends of the given angles on a die of `dies` times the diameter.
    fn part(material: &str, dies: f64, angles_deg: &[f64]) -> Nominal {
        let mut text = format!(
            "name = \"t\"\n[tube]\nod_mm = 25.4\nwall_mm = 1.65\nmaterial = \"{material}\"\n[die]\nclr_mm = {}\n\
             [end]\nlength_mm = 100\n[tolerance]\nenvelope_mm = 1\nangle_deg = 0.3\nrotation_deg = 0.5\n\
             length_mm = 0.5\n",
            25.4 * dies
        );
        for a in angles_deg {
            text += &format!("[[bend]]\nlength_mm = 100\nrotation_deg = 30\nangle_deg = {a}\n");
        }
        parse_part(&Document::new("t", text), &Materials::shipped().unwrap()).unwrap()
    }

    fn mean_and_sigma(values: &[f64]) -> (f64, f64) {
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let square: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        (mean, (square / (values.len() - 1) as f64).sqrt())
    }

    #[test]
    fn elastic_part_agrees_with_the_table_in_the_field_notes() {
        // Degrees at 90 degrees, OD 25.4 x 1.65, CLR 2 D and 3 D.
        for (material, two, three) in [
            ("steel", 0.9, 1.2),
            ("e355", 1.3, 1.8),
            ("304", 1.5, 1.9),
            ("6061-t6", 2.7, 3.9),
            ("ti-3al-2.5v", 4.2, 6.2),
        ] {
            for (dies, wanted) in [(2.0, two), (3.0, three)] {
                let part = part(material, dies, &[90.0]);
                let found = 90.0 * elastic_share(&part, part.die_clr_mm);
                assert!((found / wanted - 1.0).abs() < 0.15, "{material} {dies} D: {found} {wanted}");
            }
        }
    }

    #[test]
    fn keys_scatter_around_plausible_springback() {
        for (material, low, high) in [("steel", 1.2, 2.0), ("304", 1.8, 2.7), ("ti-3al-2.5v", 4.3, 6.0)] {
            let part = part(material, 2.0, &[90.0]);
            let table = CommandTable::from_lra(&part.lra);
            let of_key = |seed| {
                let formed = Plant::new(&part, seed).bend(&table, 400.0);
                90.0 - formed.lra.bends[0].angle_rad.to_degrees()
            };
            let (mean, sigma) = mean_and_sigma(&(0..400).map(of_key).collect::<Vec<_>>());
            assert!((low..high).contains(&mean), "{material}: {mean}");
            assert!((0.22..0.45).contains(&(sigma / mean)), "{material}: {sigma} of {mean}");
        }
    }

    #[test]
    fn tubes_of_one_batch_scatter_little() {
        let part = part("304", 2.0, &[90.0, 30.0]);
        let table = CommandTable::from_lra(&part.lra);
        let mut plant = Plant::new(&part, 5);
        let tubes: Vec<Lra> = (0..500).map(|_| plant.bend(&table, 600.0).lra).collect();
        let column = |pick: &dyn Fn(&Lra) -> f64| tubes.iter().map(pick).collect::<Vec<_>>();
        let (angle, sigma) = mean_and_sigma(&column(&|t| t.bends[0].angle_rad.to_degrees()));
        // 0.05 + 0.008 s of the bend and 0.015 s of the tube.
        let s = 90.0 - angle;
        let expected = (0.05 + 0.008 * s).hypot(0.015 * s);
        assert!((sigma / expected - 1.0).abs() < 0.15, "{sigma} {expected}");
        let (_, turn) = mean_and_sigma(&column(&|t| t.bends[1].rotation_rad.to_degrees()));
        assert!((turn / 0.08 - 1.0).abs() < 0.15, "{turn}");
        let (feed, scatter) = mean_and_sigma(&column(&|t| t.bends[1].length_mm));
        assert!(feed > 100.0 && (0.08..0.30).contains(&scatter), "{feed} {scatter}");
        let short = tubes.iter().filter(|t| t.bends[1].length_mm < feed - 0.4).count();
        assert!((1..25).contains(&short), "3 % slip, {short} of 500 seen beyond 0.4 mm");
    }

    #[test]
    fn same_seed_same_tubes() {
        let part = part("304", 2.0, &[90.0, 45.0]);
        let table = CommandTable::from_lra(&part.lra);
        let run = |seed| {
            let mut plant = Plant::new(&part, seed);
            let first = plant.bend(&table, 500.0);
            plant.new_batch();
            [first, plant.bend(&table, 500.0)]
        };
        assert_eq!(run(3), run(3));
        assert_ne!(run(3), run(4));
    }

    #[test]
    fn batches_differ_more_than_tubes() {
        let part = part("ti-3al-2.5v", 2.0, &[90.0]);
        let table = CommandTable::from_lra(&part.lra);
        let mut plant = Plant::new(&part, 11);
        let mut of_batch = |_| {
            plant.new_batch();
            90.0 - plant.bend(&table, 400.0).lra.bends[0].angle_rad.to_degrees()
        };
        let (mean, sigma) = mean_and_sigma(&(0..300).map(&mut of_batch).collect::<Vec<_>>());
        assert!((0.045..0.13).contains(&(sigma / mean)), "{sigma} of {mean}");
    }

    #[test]
    fn the_tube_is_as_long_as_its_material() {
        let part = part("304", 2.0, &[90.0, 120.0]);
        let table = CommandTable::from_lra(&part.lra);
        let cut = part.lra.developed_length_mm();
        let growth = |seed| Plant::new(&part, seed).bend(&table, cut).lra.developed_length_mm() - cut;
        let arcs: f64 = table.bends.iter().map(|b| b.angle_rad * part.die_clr_mm).sum();
        let (mean, _) = mean_and_sigma(&(0..400).map(growth).collect::<Vec<_>>());
        assert!((mean / arcs - 0.012).abs() < 0.002, "elongation {}", mean / arcs);
    }

    #[test]
    fn the_radius_grows_and_more_so_on_shallow_bends() {
        let part = part("304", 2.0, &[90.0, 15.0]);
        let formed = Plant::new(&part, 1).bend(&CommandTable::from_lra(&part.lra), 600.0).lra;
        let growth: Vec<f64> = formed.bends.iter().map(|b| b.radius_mm / part.die_clr_mm).collect();
        assert!(growth[0] > 1.005 && growth[0] < 1.05 && growth[1] > growth[0], "{growth:?}");
    }

    #[test]
    fn odd_tables_do_not_break_the_machine() {
        let part = part("ti-3al-2.5v", 3.0, &[0.0, 0.5]);
        let mut table = CommandTable::from_lra(&part.lra);
        table.bends.push(table.bends[1]);
        let formed = Plant::new(&part, 2).bend(&table, 10.0);
        assert!(formed.lra.validate().is_ok(), "{formed:?}");
        assert_eq!(formed.lra.last_length_mm, 0.0);
    }
}
