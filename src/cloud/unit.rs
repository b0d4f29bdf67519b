//! The unit of a scan file, and the check that it can be the right one.

use super::CloudError;

/// Bounding-box diagonals that a bent tube can have.
const TUBE_MM: std::ops::RangeInclusive<f64> = 20.0..=20_000.0;
/// A tube of middling size on a logarithmic scale, to choose between units that are both possible.
const MIDDLING_MM: f64 = 600.0;

/// What a coordinate of 1 in a scan file means.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Unit {
    /// 1 mm.
    #[default]
    Millimetre,
    /// 1000 mm.
    Metre,
    /// 25.4 mm.
    Inch,
}

impl Unit {
    const ALL: [Unit; 3] = [Unit::Millimetre, Unit::Metre, Unit::Inch];

    /// Millimetres per unit.
    pub fn millimetres(self) -> f64 {
        match self {
            Unit::Millimetre => 1.0,
            Unit::Metre => 1000.0,
            Unit::Inch => 25.4,
        }
    }

    /// The word for `--unit`.
    pub fn word(self) -> &'static str {
        match self {
            Unit::Millimetre => "mm",
            Unit::Metre => "m",
            Unit::Inch => "inch",
        }
    }

    /// The unit of a file whose format prescribes this one, `given` being what the operator said. Some programs
    /// write what they have: then the prescribed one gives no tube's extent and the given one does.
    pub(super) fn or_given(self, given: Unit, extent: f64, notes: &mut Vec<String>) -> Unit {
        let fits = |unit: Unit| TUBE_MM.contains(&(extent * unit.millimetres()));
        if fits(self) || !fits(given) {
            return self;
        }
        notes.push(format!("read as {}, though the format prescribes {}", given.word(), self.word()));
        given
    }

    /// Refuses an extent (a bounding box's diagonal, read in this unit) that no tube has, with a guess.
    pub(super) fn check_extent(self, file: &str, extent_mm: f64) -> Result<(), CloudError> {
        if TUBE_MM.contains(&extent_mm) {
            return Ok(());
        }
        let extent = extent_mm / self.millimetres();
        let advice = match guess(extent) {
            Some(unit) => {
                let would_be = extent * unit.millimetres();
                format!("read as {0} it would be {would_be:.1} mm: --unit {0}", unit.word())
            }
            None => "no unit makes it one: is this the scan of a tube?".to_owned(),
        };
        Err(CloudError::Extent { file: file.to_owned(), unit: self.word(), extent_mm, advice })
    }
}

impl std::str::FromStr for Unit {
    type Err = String;

    fn from_str(word: &str) -> Result<Unit, String> {
        let known = || Unit::ALL.map(Unit::word).join(", ");
        Unit::ALL.into_iter().find(|u| u.word() == word).ok_or_else(|| format!("one of {}", known()))
    }
}

/// The unit in which an extent given in file coordinates is most like a tube's.
fn guess(extent: f64) -> Option<Unit> {
    let strangeness = |u: &Unit| (extent * u.millimetres() / MIDDLING_MM).ln().abs();
    Unit::ALL
        .into_iter()
        .filter(|u| TUBE_MM.contains(&(extent * u.millimetres())))
        .min_by(|a, b| strangeness(a).total_cmp(&strangeness(b)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_guess_is_the_likeliest_unit() {
        assert_eq!(guess(0.9), Some(Unit::Metre));
        assert_eq!(guess(10.0), Some(Unit::Inch));
        assert_eq!(guess(500_000.0), None);
        assert_eq!(guess(500.0), Some(Unit::Millimetre));
        assert_eq!(guess(0.0), None);
    }

    #[test]
    fn the_prescribed_unit_yields_only_where_it_cannot_be() {
        let mut notes = Vec::new();
        assert_eq!(Unit::Metre.or_given(Unit::Millimetre, 0.5, &mut notes), Unit::Metre);
        assert_eq!(Unit::Metre.or_given(Unit::Millimetre, 1e9, &mut notes), Unit::Metre);
        assert!(notes.is_empty());
        assert_eq!(Unit::Metre.or_given(Unit::Millimetre, 500.0, &mut notes), Unit::Millimetre);
        assert_eq!(notes, ["read as mm, though the format prescribes m"]);
    }

    #[test]
    fn words_round_trip() {
        Unit::ALL.iter().for_each(|u| assert_eq!(u.word().parse(), Ok(*u)));
        assert_eq!("cm".parse::<Unit>(), Err("one of mm, m, inch".to_owned()));
    }

    #[test]
    fn limits_of_the_extent() {
        let check = |mm: f64| Unit::Millimetre.check_extent("f", mm).is_ok();
        assert!(check(20.0) && check(20_000.0));
        assert!(!check(19.99) && !check(20_001.0));
    }
}
