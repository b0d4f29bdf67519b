//! What a machine can do: read from its profile, obeyed by whoever plans a table.

/// Travel, clamp lengths and resolution of one machine. Angles in radians.
#[derive(Debug, Clone, PartialEq)]
pub struct MachineLimits {
    /// Rows that the controller can hold.
    pub max_bends: usize,
    /// Shortest first straight: the clamp must hold something.
    pub min_first_length_mm: f64,
    /// Shortest straight between bends (0 where the machine can bend on bend).
    pub min_between_mm: f64,
    /// Longest single feed.
    pub max_length_mm: f64,
    /// Largest commanded bend angle.
    pub max_angle_rad: f64,
    /// Largest commanded turn of the plane, either way.
    pub max_rotation_rad: f64,
    /// Smallest step of a length that the controller can hold.
    pub length_resolution_mm: f64,
    /// Smallest step of an angle or rotation.
    pub angle_resolution_rad: f64,
}

/// One column of a table in whole steps: what a row's rounding leaves over goes into the next row's.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct WholeSteps {
    /// Where the machine should be, in steps from the first row on.
    wanted: f64,
    /// Where whole steps bring it.
    reached: f64,
}

impl WholeSteps {
    /// Moves on by so many steps: the whole ones that it takes, and the position that they reach.
    pub fn next(&mut self, steps: f64) -> (f64, f64) {
        self.wanted += steps;
        // Rounded in one direction everywhere: a whole number of steps stays that number wherever it begins.
        let position = (self.wanted + 0.5).floor();
        (position - std::mem::replace(&mut self.reached, position), position)
    }
}

impl MachineLimits {
    /// No machine at all: what arithmetic allows. For planning before the machine is known.
    pub fn unlimited() -> MachineLimits {
        MachineLimits {
            max_bends: usize::MAX,
            min_first_length_mm: 0.0,
            min_between_mm: 0.0,
            max_length_mm: 100_000.0,
            max_angle_rad: 359.0_f64.to_radians(),
            max_rotation_rad: 3600.0_f64.to_radians(),
            length_resolution_mm: 0.0,
            angle_resolution_rad: 0.0,
        }
    }
}
