//! Cloud to measured tube: spine, arc-line spline, least-squares fit, uncertainty.
