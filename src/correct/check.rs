//! What in a knowledge file no bender and no tube can have, with its place: one such value would spoil every table of its key.

use super::Knowledge;
use super::knowledge::{JobRecord, Key, KeyRecord, MAX_JOBS};

/// The first value that cannot be: where, what was found, what is allowed.
pub fn unfit(knowledge: &Knowledge) -> Option<String> {
    for (i, record) in knowledge.keys.iter().enumerate() {
        let place = |what: String| format!("key {}{what}", i + 1);
        if knowledge.keys[..i].iter().any(|k| k.key == record.key) {
            return Some(place(": the same key stands there before; put its jobs there".to_owned()));
        }
        if let Some(what) = unfit_key(record) {
            return Some(place(what));
        }
    }
    None
}

fn unfit_key(record: &KeyRecord) -> Option<String> {
    let Key { od_mm, wall_mm, clr_mm, .. } = record.key;
    let sizes = [
        (".od_mm", od_mm, 1.0, 1000.0),
        (".wall_mm", wall_mm, 0.05, od_mm / 2.0),
        (".clr_mm", clr_mm, 0.1, 100_000.0),
    ];
    if let Some(what) = sizes.iter().find_map(|&(name, value, low, high)| outside(name, value, low, high)) {
        return Some(what);
    }
    if record.jobs.len() > MAX_JOBS {
        return Some(format!(": {} jobs, allowed are {MAX_JOBS}", record.jobs.len()));
    }
    for (k, job) in record.jobs.iter().enumerate() {
        let place = |what: String| format!(", job {} ({:?}){what}", k + 1, job.id);
        if record.jobs[..k].iter().any(|j| j.id == job.id) {
            return Some(place(": a job with the same id stands before it; leave one out".to_owned()));
        }
        if let Some(what) = unfit_job(job) {
            return Some(place(what));
        }
    }
    None
}

fn unfit_job(job: &JobRecord) -> Option<String> {
    let deg = f64::to_degrees;
    let bends = job.bends.iter().enumerate().find_map(|(i, p)| {
        let name = |field: &str| format!(", bend {}.{field}", i + 1);
        outside(&name("commanded_deg"), deg(p.commanded_rad), 0.0, 360.0)
            .or_else(|| outside(&name("radius_mm"), p.radius_mm, 0.1, 100_000.0))
            .or_else(|| outside(&name("springback_deg"), deg(p.springback_rad), -90.0, 90.0))
            .or_else(|| outside(&name("sigma_deg"), deg(p.sigma_rad), 1e-6, 90.0))
    });
    let straights = || {
        job.straights.iter().enumerate().find_map(|(i, p)| {
            let name = |field: &str| format!(", straight {}.{field}", i + 1);
            let side = p.sides.iter().find_map(|side| {
                outside(&name("sides.radius_mm"), side.radius_mm, 0.1, 100_000.0)
                    .or_else(|| outside(&name("sides.commanded_deg"), deg(side.commanded_rad), 0.0, 360.0))
                    .or_else(|| outside(&name("sides.formed_deg"), deg(side.formed_rad), 0.0, 360.0))
            });
            side.or_else(|| outside(&name("growth_mm"), p.growth_mm, -1e4, 1e4))
                .or_else(|| outside(&name("sigma_mm"), p.sigma_mm, 1e-6, 1e4))
        })
    };
    let turns = || {
        job.turns.iter().enumerate().find_map(|(i, p)| {
            let name = |field: &str| format!(", turn {}.{field}", i + 1);
            outside(&name("per_backlash"), p.per_backlash, -1.0, 1.0)
                .or_else(|| outside(&name("off_deg"), deg(p.off_rad), -180.0, 180.0))
                .or_else(|| outside(&name("sigma_deg"), deg(p.sigma_rad), 1e-6, 360.0))
        })
    };
    bends.or_else(straights).or_else(turns)
}

/// Said where a value is outside its range.
fn outside(name: &str, value: f64, low: f64, high: f64) -> Option<String> {
    let fits = (low..=high).contains(&value);
    (!fits).then(|| format!("{name} = {value}, allowed is {low} to {high}"))
}
