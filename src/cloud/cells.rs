//! Space cut into cubes: the cell of a point, and numbers for the cells that are occupied. Thinning, ordering and
//! the radius search stand on it.

use nalgebra::Vector3;

use super::PointCloud;

/// Bits per axis of a cell's key.
const BITS: u32 = 21;
/// Cells per axis that a key can tell apart.
const MOST_CELLS: f64 = (1u64 << BITS) as f64;

/// A grid of cubes anchored at a cloud's own corner.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cells {
    min: [f64; 3],
    /// 1 / edge.
    per_mm: f64,
}

impl Cells {
    /// A cell too small for the grid (or not above 0) is enlarged to the finest that the grid can hold. None for
    /// an empty cloud.
    pub fn of(cloud: &PointCloud, cell_mm: f64) -> Option<Cells> {
        let (min, max) = cloud.offset_bounds()?;
        let min: Vector3<f64> = min.cast();
        let finest = (max.cast::<f64>() - min).max() / (MOST_CELLS - 1.0);
        // f64::max also answers `finest` for NaN; 1.0 only when all points are one.
        let cell = cell_mm.max(finest);
        let cell = if cell > 0.0 { cell } else { 1.0 };
        Some(Cells { min: min.into(), per_mm: 1.0 / cell })
    }

    /// Edge of a cell.
    pub fn edge_mm(&self) -> f64 {
        1.0 / self.per_mm
    }

    /// Number of the cell along each axis, for any place; 0 at and below the corner.
    pub fn at(&self, offset: [f64; 3]) -> [u32; 3] {
        std::array::from_fn(|i| ((offset[i] - self.min[i]) * self.per_mm) as u32)
    }

    /// Key of the cell of one of the cloud's points.
    pub fn key(&self, offset: [f32; 3]) -> u64 {
        key(self.at(offset.map(f64::from)))
    }
}

/// The three numbers of a cell in one.
pub(super) fn key(at: [u32; 3]) -> u64 {
    at.iter().rev().fold(0, |key, &n| key << BITS | u64::from(n))
}

/// The three numbers again.
pub(super) fn numbers(key: u64) -> [u64; 3] {
    [0, 1, 2].map(|i| key >> (i * BITS) & ((1 << BITS) - 1))
}

/// Numbers the keys it is given from 0 in the order of their first appearance.
#[derive(Debug, Clone)]
pub(super) struct Numbers {
    pub keys: Vec<u64>,
    /// Number + 1, 0 where free; a power of two of them, at most half in use.
    slots: Vec<u32>,
    shift: u32,
}

impl Numbers {
    pub fn new() -> Numbers {
        Numbers { keys: Vec::new(), slots: vec![0; 256], shift: 64 - 8 }
    }

    /// The slot that holds the key, or the free one where it would be.
    fn slot(&self, key: u64) -> usize {
        let mut slot = (key.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> self.shift) as usize;
        while let Some(number) = self.slots[slot].checked_sub(1)
            && self.keys[number as usize] != key
        {
            slot = (slot + 1) & (self.slots.len() - 1);
        }
        slot
    }

    /// The number of a key, if it has one.
    pub fn find(&self, key: u64) -> Option<u32> {
        self.slots[self.slot(key)].checked_sub(1)
    }

    /// The number of a key, a new one if need be.
    pub fn number(&mut self, key: u64) -> u32 {
        let slot = self.slot(key);
        if let Some(number) = self.slots[slot].checked_sub(1) {
            return number;
        }
        self.keys.push(key);
        let number = self.keys.len() as u32;
        self.slots[slot] = number;
        if self.keys.len() * 2 > self.slots.len() {
            self.grow();
        }
        number - 1
    }

    fn grow(&mut self) {
        self.slots = vec![0; self.slots.len() * 4];
        self.shift -= 2;
        for number in 1..=self.keys.len() as u32 {
            let slot = self.slot(self.keys[number as usize - 1]);
            self.slots[slot] = number;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_has_one_number() {
        let mut numbers = Numbers::new();
        let key = |i: u64| i.wrapping_mul(1 << 40) ^ i;
        for _ in 0..2 {
            (0..5000).for_each(|i| assert_eq!(numbers.number(key(i)), i as u32));
        }
        assert_eq!((numbers.find(key(4999)), numbers.find(key(5000))), (Some(4999), None));
    }

    #[test]
    fn keys_hold_their_numbers() {
        for at in [[0, 0, 0], [1, 2, 3], [(1 << 21) - 1, 0, (1 << 21) - 1]] {
            assert_eq!(numbers(key(at)), at.map(u64::from));
        }
    }
}
