//! What is said of spring-back outside this program, row by row: a controller's pair, a shop's overbend list, a bent test.
//!
//! Inside, spring-back belongs to the commanded angle c: s(c) = c - formed. A table that is looked up with the drawing's angle
//! d says how much to command beyond it: S(d) = c - d, and since d is what comes out, that is s(d + S(d)). So a row (d, S) is the
//! point (d + S, S), for any law. For the straight line S = A d + B that is s = A/(1+A) c + B/(1+A).

/// What the two columns of a table are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SpringbackForm {
    /// A controller's pair, looked up with the drawing's angle.
    Designed,
    /// A controller's pair, looked up with the angle that the machine bends to.
    Commanded,
    /// A shop's list: the drawing's angle, and how much more is bent.
    Overbend,
    /// Bends of a test tube: the angle commanded, and the one measured on it.
    Test,
}

/// Rows of one form.
#[derive(Debug, Clone, PartialEq)]
pub struct SpringbackTable {
    /// What the columns are.
    pub form: SpringbackForm,
    /// First and second column of each row.
    pub rows_rad: Vec<[f64; 2]>,
}

impl SpringbackTable {
    /// Commanded angle and spring-back of each row.
    pub fn points(&self) -> impl Iterator<Item = (f64, f64)> {
        self.rows_rad.iter().map(|&[angle, other]| match self.form {
            SpringbackForm::Designed | SpringbackForm::Overbend => (angle + other, other),
            SpringbackForm::Commanded => (angle, other),
            SpringbackForm::Test => (angle, angle - other),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// s = 1 + 0.02 c. Drawn 20: c = 21/0.98 = 21.428571, S = 1.428571; drawn 120: c = 121/0.98 = 123.469388, S = 3.469388.
    #[test]
    fn the_drawings_angle_and_the_commanded_one_say_the_same_by_hand() {
        let designed = SpringbackTable {
            form: SpringbackForm::Designed,
            rows_rad: vec![[20.0, 1.428_571_428_571], [120.0, 3.469_387_755_102]],
        };
        let points: Vec<(f64, f64)> = designed.points().collect();
        for (c, s) in &points {
            assert!((s - (1.0 + 0.02 * c)).abs() < 1e-9, "{c} {s}");
        }
        assert!((points[0].0 - 21.428_571_428_571).abs() < 1e-9);
        // The line itself: A = 0.02/0.98, B = 1/0.98 in the drawing's angle is a = A/(1+A), b = B/(1+A) in the commanded one.
        let (slope, constant) = (0.02 / 0.98, 1.0 / 0.98);
        assert!((designed.rows_rad[1][1] - (slope * 120.0 + constant)).abs() < 1e-9);
        assert!((slope / (1.0 + slope) - 0.02_f64).abs() < 1e-12);
        assert!((constant / (1.0 + slope) - 1.0_f64).abs() < 1e-12);
    }

    #[test]
    fn a_test_is_what_was_commanded_and_measured() {
        let test = SpringbackTable { form: SpringbackForm::Test, rows_rad: vec![[60.0, 58.7]] };
        let (c, s) = test.points().next().unwrap();
        assert!(c == 60.0 && (s - 1.3).abs() < 1e-12);
    }
}
