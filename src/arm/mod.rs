//! Where scans come from.
