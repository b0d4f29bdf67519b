//! Measured tube against nominal: alignment, deviations, verdict.
