//! The whole-tube view of `correct`: what one value cannot be is made up for by the others, so that the check points come right.

#![allow(clippy::unwrap_used, clippy::print_stdout)] // clippy does not count the helpers of an integration test as test code

mod common;

use benderd::bender::Profile;
use benderd::correct::next_tube::NextTube;
use benderd::correct::replay::{Job, Model, Replay, replay};
use benderd::correct::shape::Case;
use benderd::correct::{Answer, Code, History, Knowledge, Limits, Part, Verdict, step};
use benderd::sim::forming::Plant;
use benderd::tube::{Alignment, Bend, CommandTable, Lra, MachineLimits, Nominal};
use common::measured;
use proptest::prelude::*;

const ALL: [Alignment; 5] =
    [Alignment::BestFit, Alignment::AEnd, Alignment::BEnd, Alignment::Weighted, Alignment::Fixture];

/// Rows of length, rotation, angle; then the last straight.
fn nominal(rows: &[(f64, f64, f64)], last_length_mm: f64) -> Nominal {
    let bend = |&(length_mm, rotation, angle): &(f64, f64, f64)| Bend {
        length_mm,
        rotation_rad: rotation.to_radians(),
        angle_rad: angle.to_radians(),
        radius_mm: 60.0,
    };
    Nominal::of_table(Lra { bends: rows.iter().map(bend).collect(), last_length_mm }, 25.4, 1.65)
}

/// 2 m developed, six bends.
fn two_metres() -> Nominal {
    let rows = [
        (210.0, 0.0, 90.0),
        (245.0, 90.0, 45.0),
        (180.0, -60.0, 60.0),
        (240.0, 150.0, 30.0),
        (195.0, -35.0, 75.0),
        (260.0, 70.0, 40.0),
    ];
    nominal(&rows, 313.0)
}

/// The same length stretched out: eight shallow bends.
fn stretched() -> Nominal {
    let rows = [
        (180.0, 0.0, 25.0),
        (210.0, 160.0, 33.0),
        (195.0, -150.0, 21.0),
        (220.0, 175.0, 38.0),
        (190.0, 90.0, 28.0),
        (215.0, -120.0, 35.0),
        (200.0, 170.0, 24.0),
        (205.0, 145.0, 31.0),
    ];
    nominal(&rows, 240.0)
}

fn three_bends() -> Nominal {
    nominal(&[(150.0, 0.0, 80.0), (320.0, 75.0, 50.0), (240.0, -40.0, 65.0)], 400.0)
}

fn machine(step_deg: f64, step_mm: f64) -> Limits {
    let angle_resolution_rad = step_deg.to_radians();
    let machine =
        MachineLimits { angle_resolution_rad, length_resolution_mm: step_mm, ..MachineLimits::unlimited() };
    Limits { machine, ..Limits::default() }
}

fn ten_row() -> Limits {
    Limits { machine: Profile::load("ten-row").unwrap().limits, ..Limits::default() }
}

fn history(parts: Vec<Part>) -> History {
    History { parts, ..History::default() }
}

fn part(commanded: &CommandTable, tube: &Lra, id: usize) -> Part {
    Part { scan_id: Some(id.to_string()), ..Part::new(commanded.clone(), measured(tube, 0.03)) }
}

fn ask(nominal: &Nominal, history: &History, limits: &Limits) -> Answer {
    step(nominal, history, &Knowledge::default(), limits)
}

/// A job of some parts bent on a simulated machine with unlimited steps, whose tubes need correcting.
fn job(nominal: &Nominal, parts: usize, seed: u64) -> History {
    job_within(&Limits::default(), nominal, parts, seed)
}

fn job_within(limits: &Limits, nominal: &Nominal, parts: usize, seed: u64) -> History {
    let mut plant = Plant::new(nominal, seed);
    let mut out = History::default();
    for id in 0..parts {
        let table = ask(nominal, &out, limits).commanded;
        let formed = plant.bend(&table, 5000.0).lra;
        out.parts.push(part(&table, &formed, id));
    }
    out
}

/// What is believed after a history.
fn believed(nominal: &Nominal, history: &History, limits: &Limits) -> Replay {
    replay(&Job { nominal, history, knowledge: &Knowledge::default(), limits }, false)
}

fn rms_mm(model: &Model, nominal: &Nominal, table: &CommandTable) -> f64 {
    let off = NextTube::new(model, nominal, table).unwrap().overlay.off_mm;
    (off.iter().map(|off| off.norm_squared()).sum::<f64>() / off.len() as f64).sqrt()
}

fn worst_mm(model: &Model, nominal: &Nominal, table: &CommandTable) -> f64 {
    NextTube::new(model, nominal, table).unwrap().worst_point().1
}

/// Every value to the nearest step, whatever is left over.
fn nearest(table: &CommandTable, limits: &Limits) -> CommandTable {
    let (mm, rad) = (limits.machine.length_resolution_mm, limits.machine.angle_resolution_rad);
    let mut out = table.clone();
    for row in &mut out.bends {
        row.length_mm = (row.length_mm / mm).round() * mm;
        row.rotation_rad = (row.rotation_rad / rad).round() * rad;
        row.angle_rad = (row.angle_rad / rad).round() * rad;
    }
    out
}

fn whole_steps(table: &CommandTable, limits: &Limits) -> bool {
    let whole = |value: f64, step: f64| step == 0.0 || (value / step - (value / step).round()).abs() < 1e-6;
    table.bends.iter().all(|row| {
        whole(row.length_mm, limits.machine.length_resolution_mm)
            && whole(row.rotation_rad, limits.machine.angle_resolution_rad)
            && whole(row.angle_rad, limits.machine.angle_resolution_rad)
    })
}

fn codes(answer: &Answer) -> Vec<Code> {
    answer.reasons.iter().map(|r| r.code).collect()
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

/// What every table is judged by after this history: the sum of squares that is least for the best.
fn cost_of(case: &Case, table: &CommandTable) -> f64 {
    let (_, weights) = case.cost(&case.aims(table)).unwrap();
    weights.cost(&case.next_tube(table).unwrap(), case.nominal)
}

fn case<'a>(read: &'a Replay, nominal: &'a Nominal, limits: &'a Limits) -> Case<'a> {
    Case { model: &read.model, nominal, newest: read.used.last(), limits }
}

fn moves_on(answer: &Answer) -> bool {
    matches!(answer.verdict, Verdict::FirstPiece | Verdict::Correct)
}

fn keeps_the_table(answer: &Answer, history: &History) -> bool {
    history.parts.last().is_some_and(|part| part.commanded == answer.commanded)
}

#[test]
fn a_machine_of_whole_degrees_is_told_a_far_better_table_of_two_metres() {
    told_better(&two_metres(), 0.7);
    told_better(&stretched(), 0.7);
}

fn told_better(nominal: &Nominal, share: f64) {
    let limits = ten_row();
    let (mut by_itself, mut carried, mut whole) = (Vec::new(), Vec::new(), Vec::new());
    for seed in 0..40 {
        let history = job(nominal, (seed % 3) as usize, seed);
        let answer = ask(nominal, &history, &limits);
        if !moves_on(&answer) || keeps_the_table(&answer, &history) {
            continue;
        }
        let read = believed(nominal, &history, &limits);
        let case = case(&read, nominal, &limits);
        let aims = case.aims(&answer.commanded);
        let predicted = answer.predicted.as_ref().unwrap();
        assert!(whole_steps(&answer.commanded, &limits), "{:?}", answer.commanded);
        let said = worst_mm(&read.model, nominal, &answer.commanded);
        assert!((predicted.worst.deviation_mm - said).abs() < 1e-6);
        by_itself.push(worst_mm(&read.model, nominal, &nearest(&aims, &limits)));
        carried.push(worst_mm(&read.model, nominal, &case.each_for_itself(&answer.commanded)));
        whole.push(said);
        let good = NextTube::new(&read.model, nominal, &answer.commanded).unwrap().share(nominal) <= 1.0;
        let coarse = answer.reasons.iter().find(|r| r.code == Code::Resolution);
        assert_eq!(coarse.is_none(), good);
        let text = coarse.map_or("", |r| &r.text);
        assert!(good || text.contains("steps of 1 mm and 1 degrees are too coarse"), "{text}");
        let better = whole.last() < carried.last();
        assert_eq!(codes(&answer).contains(&Code::WholeTube), better, "{:?}", answer.reasons);
    }
    println!(
        "worst check point of {} tables, mean: {:.2} mm each value to the nearest, {:.2} with remainders carried, {:.2} for the \
         whole tube",
        whole.len(),
        mean(&by_itself),
        mean(&carried),
        mean(&whole)
    );
    assert!(
        whole.len() >= 20 && mean(&whole) < share * mean(&by_itself) && mean(&whole) < share * mean(&carried)
    );
}

/// Formed tubes, not predictions: the same plant, tables for the whole tube or each value for itself.
#[test]
fn a_machine_of_whole_degrees_bends_better_tubes() {
    bends_better(&two_metres());
    bends_better(&stretched());
}

fn bends_better(nominal: &Nominal) {
    let limits = ten_row();
    let (mut whole, mut each, mut changes) = (Vec::new(), Vec::new(), 0);
    for seed in 0..40 {
        for for_the_tube in [true, false] {
            let mut plant = Plant::new(nominal, 1000 + seed);
            let mut job = History::default();
            for id in 0..6 {
                let answer = ask(nominal, &job, &limits);
                let mut table = answer.commanded;
                if !for_the_tube {
                    let read = believed(nominal, &job, &limits);
                    table = case(&read, nominal, &limits).each_for_itself(&table);
                }
                let formed = plant.bend(&table, 5000.0).lra;
                let mut trimmed = formed.clone();
                trimmed.last_length_mm = nominal.lra.last_length_mm;
                if id >= 3 {
                    let off = inspected_mm(&trimmed, nominal);
                    if for_the_tube {
                        whole.push(off)
                    } else {
                        each.push(off)
                    }
                    let last = &job.parts.last().unwrap().commanded;
                    changes += usize::from(for_the_tube && *last != table);
                }
                job.parts.push(part(&table, &formed, id));
            }
        }
    }
    println!(
        "worst check point of tubes 4 to 6, mean: {:.2} mm for the whole tube, {:.2} each value for itself; {changes} of {} tables \
         changed",
        mean(&whole),
        mean(&each),
        whole.len()
    );
    assert!(mean(&whole) < 0.8 * mean(&each));
}

/// The worst check point of a tube as bent, on the nominal's radii.
fn inspected_mm(tube: &Lra, nominal: &Nominal) -> f64 {
    let seen = benderd::inspect::inspect(&measured(tube, 0.0), nominal).unwrap();
    seen.points.iter().map(|p| p.deviation_mm).fold(0.0, f64::max)
}

/// Well known by two good tubes, then one with a bend 6 degrees short, twice: more than a part may bring.
fn held_back(nominal: &Nominal, bend: usize) -> History {
    let table = ask(nominal, &History::default(), &Limits::default()).commanded;
    let mut bad = nominal.lra.clone();
    bad.bends[bend].angle_rad -= 6f64.to_radians();
    let parts = [&nominal.lra, &nominal.lra, &bad, &bad].into_iter().enumerate();
    history(parts.map(|(id, tube)| part(&table, tube, id)).collect())
}

#[test]
fn what_a_step_limit_holds_back_the_other_values_make_up_for() {
    let nominal = two_metres();
    let limits = Limits::default();
    let history = held_back(&nominal, 2);
    let answer = ask(&nominal, &history, &limits);
    assert_eq!(answer.verdict, Verdict::Correct);
    let read = believed(&nominal, &history, &limits);
    let case = case(&read, &nominal, &limits);
    let each = worst_mm(&read.model, &nominal, &case.aims(&answer.commanded));
    let whole = answer.predicted.as_ref().unwrap().worst.deviation_mm;
    println!(
        "angle held by the step limit: worst check point {whole:.2} mm, {each:.2} each value for itself"
    );
    assert!(whole < 0.8 * each, "{whole} {each}");
    let change = answer.commanded.bends[2].angle_rad - history.parts[0].commanded.bends[2].angle_rad;
    assert!((1.99..2.0 + 1e-9).contains(&change.to_degrees()), "{}", change.to_degrees());
    for (value, aim) in case.values(&answer.commanded).chunks(3).zip(&answer.commanded.bends) {
        let found = [aim.length_mm, aim.rotation_rad, aim.angle_rad];
        assert!(value.iter().zip(found).all(|(v, f)| v.low - 1e-9 <= f && f <= v.high + 1e-9));
        let free = (aim.angle_rad - value[2].best).abs() <= 0.5 * nominal.tolerance.angle_rad + 1e-9;
        assert!(free || value[2].best > value[2].high, "no free angle leaves half its tolerance");
    }
    let reason = answer.reasons.iter().find(|r| r.code == Code::OutOfReach).unwrap();
    assert!(reason.bend == Some(3) && reason.text.contains("angle 3 is held at"), "{}", reason.text);
    assert!(codes(&answer).contains(&Code::StepLimit) && !codes(&answer).contains(&Code::Resolution));
}

#[test]
fn what_a_clamp_holds_the_other_values_make_up_for() {
    let nominal =
        nominal(&[(150.0, 0.0, 60.0), (100.0, 0.0, 60.0), (90.0, 180.0, 70.0), (160.0, 90.0, 40.0)], 200.0);
    let free = ask(&nominal, &History::default(), &Limits::default()).commanded;
    let mut limits = Limits::default();
    limits.machine.min_between_mm = free.bends[2].length_mm + 1.5;
    let first = ask(&nominal, &History::default(), &limits);
    assert_eq!(first.verdict, Verdict::FirstPiece);
    assert_eq!(first.commanded.bends[2].length_mm, limits.machine.min_between_mm);
    let (mut each, mut whole) = (Vec::new(), Vec::new());
    for seed in 0..20 {
        let history = job_within(&limits, &nominal, 2, seed);
        let answer = ask(&nominal, &history, &limits);
        let feed_mm = answer.commanded.bends[2].length_mm;
        if answer.verdict != Verdict::Correct || feed_mm > limits.machine.min_between_mm {
            continue;
        }
        let read = believed(&nominal, &history, &limits);
        let case = case(&read, &nominal, &limits);
        each.push(rms_mm(&read.model, &nominal, &case.aims(&answer.commanded)));
        whole.push(rms_mm(&read.model, &nominal, &answer.commanded));
        if let Some(reason) = answer.reasons.iter().find(|r| r.code == Code::OutOfReach) {
            let text = &reason.text;
            assert!(reason.bend == Some(3) && text.contains("the machine feeds no less"), "{text}");
        }
    }
    let (whole, each, jobs) = (mean(&whole), mean(&each), whole.len());
    println!(
        "feed held by the clamp, {jobs} jobs: check points {whole:.2} mm off (rms), {each:.2} each for itself"
    );
    assert!(jobs >= 8 && whole < 0.85 * each, "{whole} {each}");
}

#[test]
fn the_named_alignment_decides_which_shape_is_best() {
    let base = two_metres();
    let limits = Limits::default();
    let history = held_back(&base, 2);
    let parts = ALL.map(|alignment| {
        let mut nominal = base.clone();
        nominal.tolerance.alignment = alignment;
        nominal
    });
    let answers = parts.each_ref().map(|nominal| ask(nominal, &history, &limits));
    for (nominal, answer) in parts.iter().zip(&answers) {
        let alignment = nominal.tolerance.alignment;
        assert_eq!(answer.predicted.as_ref().unwrap().alignment, alignment);
        let read = believed(nominal, &history, &limits);
        let case = case(&read, nominal, &limits);
        let (_, weights) = case.cost(&case.aims(&answer.commanded)).unwrap();
        let cost = |table: &CommandTable| weights.cost(&case.next_tube(table).unwrap(), nominal);
        let costs: Vec<f64> = answers.iter().map(|other| cost(&other.commanded)).collect();
        println!(
            "{alignment:>8}: {:.2?}, each value for itself {:.2}",
            costs,
            cost(&case.aims(&answer.commanded))
        );
        let own = cost(&answer.commanded);
        assert!(costs.iter().all(|other| own <= other * 1.001), "{alignment}: {own} {costs:?}");
        assert!(own < cost(&case.aims(&answer.commanded)));
    }
    for (i, a) in answers.iter().enumerate() {
        assert!(answers[..i].iter().all(|b| a.commanded != b.commanded), "{}", ALL[i]);
    }
}

/// All tables whose values are one of the two or three steps around their best.
#[test]
fn no_neighbouring_rounding_of_three_bends_is_much_better() {
    let nominal = three_bends();
    let limits = machine(1.0, 1.0);
    let (mut found_best, mut tried) = (0, 0);
    let mut worst_ratio: f64 = 1.0;
    for seed in 0..40 {
        let history = job(&nominal, (seed % 3) as usize, 100 + seed);
        let answer = ask(&nominal, &history, &limits);
        if !moves_on(&answer) || keeps_the_table(&answer, &history) {
            continue;
        }
        let read = believed(&nominal, &history, &limits);
        let case = case(&read, &nominal, &limits);
        let aims = case.aims(&answer.commanded);
        let (_, weights) = case.cost(&aims).unwrap();
        let cost = |table: &CommandTable| weights.cost(&case.next_tube(table).unwrap(), &nominal);
        let steps = [1.0, 1f64.to_radians(), 1f64.to_radians()];
        let values: Vec<f64> =
            aims.bends.iter().flat_map(|r| [r.length_mm, r.rotation_rad, r.angle_rad]).collect();
        let mut least = f64::INFINITY;
        for combination in 0..1 << 9 {
            let mut table = answer.commanded.clone();
            for (k, value) in values.iter().enumerate() {
                let row = &mut table.bends[k / 3];
                let up = f64::from(combination >> k & 1);
                let place = [&mut row.length_mm, &mut row.rotation_rad, &mut row.angle_rad];
                *place.into_iter().nth(k % 3).unwrap() = ((value / steps[k % 3]).floor() + up) * steps[k % 3];
            }
            least = least.min(cost(&table));
        }
        let own = cost(&answer.commanded);
        tried += 1;
        found_best += usize::from(own <= least * (1.0 + 1e-6));
        worst_ratio = worst_ratio.max(own / least);
        assert!(own <= 1.1 * least, "seed {seed}: {own} {least}");
    }
    println!(
        "best of all 512 roundings found in {found_best} of {tried} jobs, at worst {worst_ratio:.3} times its cost"
    );
    assert!(tried >= 12 && 2 * found_best > tried);
}

#[test]
fn where_nothing_is_held_the_table_stays_as_planned() {
    let nominal = three_bends();
    let fine = machine(0.001, 0.01);
    let mut seen = 0;
    for seed in 0..20 {
        let history = job(&nominal, 1 + (seed % 2) as usize, seed);
        let answer = ask(&nominal, &history, &Limits::default());
        if answer.verdict != Verdict::Correct || codes(&answer).contains(&Code::StepLimit) {
            continue;
        }
        seen += 1;
        let read = believed(&nominal, &history, &fine);
        let case = case(&read, &nominal, &fine);
        let of_fine = ask(&nominal, &history, &fine);
        let aims = case.aims(&answer.commanded);
        for (table, mm) in [(&answer.commanded, 1e-9), (&of_fine.commanded, 0.005 + 1e-9)] {
            for (row, aim) in table.bends.iter().zip(&aims.bends) {
                assert!((row.length_mm - aim.length_mm).abs() <= mm);
                assert!((row.angle_rad - aim.angle_rad).to_degrees().abs() <= mm / 10.0);
                assert!((row.rotation_rad - aim.rotation_rad).to_degrees().abs() <= mm / 10.0);
            }
        }
        for answer in [&answer, &of_fine] {
            let said = codes(answer);
            assert!([Code::WholeTube, Code::Resolution, Code::OutOfReach].iter().all(|c| !said.contains(c)));
            assert!(answer.predicted.as_ref().unwrap().worst.deviation_mm < 0.1);
        }
    }
    assert!(seen >= 8, "{seen}");
}

#[test]
fn tubes_come_out_where_they_are_expected() {
    let nominal = two_metres();
    let (mut within, mut all) = (0, 0);
    for seed in 0..60 {
        let mut job = job(&nominal, 2, 500 + seed);
        let answer = ask(&nominal, &job, &Limits::default());
        let Some(predicted) = &answer.predicted else { continue };
        let mut plant = Plant::new(&nominal, 500 + seed);
        job.parts.iter().for_each(|p| drop(plant.bend(&p.commanded, 5000.0)));
        let mut tube = plant.bend(&answer.commanded, 5000.0).lra;
        tube.last_length_mm = nominal.lra.last_length_mm;
        let seen = benderd::inspect::inspect(&measured(&tube, 0.0), &nominal).unwrap();
        for (said, found) in predicted.points.iter().zip(&seen.points) {
            assert_eq!((said.straight, said.place), (found.straight, found.place));
            all += 1;
            within += usize::from(found.deviation_mm <= said.deviation_mm + 3.0 * said.sigma_mm);
        }
        job.parts.clear();
    }
    println!("{within} of {all} check points within the expected deviation and three sigmas");
    assert!(all > 500 && within as f64 > 0.95 * all as f64);
}

#[test]
fn a_hold_predicts_nothing_and_rows_without_a_bend_have_no_angle() {
    let mut nominal = three_bends();
    let row = nominal.lra.bends[1];
    nominal.lra.bends.insert(1, Bend { length_mm: 30.0, rotation_rad: 0.0, angle_rad: 0.0, ..row });
    let answer = ask(&nominal, &History::default(), &machine(1.0, 1.0));
    let predicted = answer.predicted.unwrap();
    assert_eq!((predicted.angle_deviation_deg.len(), predicted.angle_deviation_deg[1]), (4, 0.0));
    assert_eq!(predicted.points.len(), 12);
    let mirrored = history(vec![part(&answer.commanded, &nominal.lra.mirrored().merged(), 0)]);
    let held = ask(&nominal, &mirrored, &Limits::default());
    assert_eq!((held.verdict, held.predicted), (Verdict::Hold, None));
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, cases: 48, ..ProptestConfig::default() })]

    /// Whatever the steps and the limits, the table costs no more than each value for itself, and keeps its limits.
    #[test]
    fn the_shape_is_never_worse_than_each_value_for_itself(
        seed in 0..1000_u64, parts in 0..3_usize, step_deg in prop::sample::select(vec![0.0, 0.02, 0.1, 0.5, 1.0]),
        step_mm in prop::sample::select(vec![0.0, 0.1, 1.0]), most_deg in 0.2..3.0_f64, alignment in prop::sample::select(ALL.to_vec()),
        shortest in 0.0..250.0_f64,
    ) {
        let mut nominal = three_bends();
        nominal.tolerance.alignment = alignment;
        let mut limits = machine(step_deg, step_mm);
        limits.step_angle_rad = most_deg.to_radians();
        limits.machine.min_between_mm = shortest;
        let history = job(&nominal, parts, seed);
        let answer = ask(&nominal, &history, &limits);
        prop_assume!(moves_on(&answer) && !keeps_the_table(&answer, &history));
        let read = believed(&nominal, &history, &limits);
        let case = case(&read, &nominal, &limits);
        let share = |table| case.next_tube(table).unwrap().share(&nominal);
        // A tube that is accepted comes before one that costs less.
        prop_assume!(share(&answer.commanded) > 1.0 || share(&case.each_for_itself(&answer.commanded)) <= 1.0);
        let (own, each) = (cost_of(&case, &answer.commanded), cost_of(&case, &case.each_for_itself(&answer.commanded)));
        // Where it does not matter the plan stays, whatever rounding makes of it.
        let matters = case.matters(&case.next_tube(&case.each_for_itself(&answer.commanded)).unwrap());
        prop_assert!(!matters || own <= 1.01 * each + 1e-6, "{own} {each}");
        for (k, value) in case.values(&answer.commanded).iter().enumerate() {
            let row = &answer.commanded.bends[k / 3];
            let found = [row.length_mm, row.rotation_rad, row.angle_rad][k % 3];
            let step = [step_mm, step_deg.to_radians(), step_deg.to_radians()][k % 3];
            prop_assert!(value.low - step - 1e-9 <= found && found <= value.high + step + 1e-9, "{k} {value:?} {found}");
        }
    }
}
