//! Where a scan's passes end: boundaries between chunks of the file that explain the most.
//!
//! Under `realign`.

use super::blocks::Blocks;

/// Passes of a scan at most: what seems to have more is not made in passes.
const MOST_PASSES: usize = 16;

/// How far a boundary may be looked for anew when another is added, in chunks.
const BESIDE: usize = 4;

/// Times that every boundary is looked for anew beside the others.
const ROUNDS: usize = 2;

/// Boundaries added one by one as long as each is worth its price, the best first. None without any, and
/// where there is no end of them.
pub fn boundaries(blocks: &Blocks, price: f64) -> Option<Vec<usize>> {
    let mut found = Vec::new();
    let (mut gain, _) = blocks.gain(&found)?;
    while found.len() + 1 < MOST_PASSES {
        let with = |b: usize| {
            let mut more: Vec<usize> = found.iter().copied().chain([b]).collect();
            more.sort_unstable();
            more
        };
        let tried = (1..blocks.chunks).filter(|b| !found.contains(b));
        let tried = tried.filter_map(|b| Some((blocks.gain(&with(b))?.0, b)));
        let Some((best, b)) = tried.max_by(|a, b| a.0.total_cmp(&b.0)) else { break };
        let more = settled(blocks, with(b), BESIDE);
        let best = blocks.gain(&more)?.0.max(best);
        if best - gain < price {
            break;
        }
        (found, gain) = (more, best);
    }
    (1..MOST_PASSES - 1).contains(&found.len()).then_some(found)
}

/// Every boundary where it is worth the most, no farther from where it was than `reach`.
pub fn settled(blocks: &Blocks, mut found: Vec<usize>, reach: usize) -> Vec<usize> {
    for _ in 0..ROUNDS {
        for k in 0..found.len() {
            let least = found[k].saturating_sub(reach).max(if k > 0 { found[k - 1] + 1 } else { 1 });
            let most = (found[k] + reach).min(found.get(k + 1).map_or(blocks.chunks, |next| *next) - 1);
            let at = |b: usize| {
                let mut other = found.clone();
                other[k] = b;
                blocks.gain(&other).map(|g| (g.0, b))
            };
            let best = (least..=most).filter_map(at).max_by(|a, b| a.0.total_cmp(&b.0));
            found[k] = best.map_or(found[k], |b| b.1);
        }
    }
    found
}

/// The boundaries without those that are not worth their price beside the others: two may have stood for one inside a chunk.
pub fn needed(blocks: &Blocks, mut found: Vec<usize>, reach: usize, price: f64) -> Vec<usize> {
    while found.len() > 1 {
        let less = |k: usize| {
            let mut other = found.clone();
            other.remove(k);
            let other = settled(blocks, other, reach);
            Some((blocks.gain(&other)?.0, other))
        };
        let best = (0..found.len()).filter_map(less).max_by(|a, b| a.0.total_cmp(&b.0));
        let all = blocks.gain(&found).map_or(0.0, |g| g.0);
        match best {
            Some((gain, fewer)) if all - gain < price => found = fewer,
            _ => break,
        }
    }
    found
}
