//! Statistics that a few wild values do not spoil.

/// Median of |x| to standard deviation for normal errors.
pub const MEDIAN_TO_SIGMA: f64 = 1.4826;

/// Median; None without values.
pub fn median(values: &mut [f64]) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let middle = values.len() / 2;
    let (_, m, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    Some(*m)
}
