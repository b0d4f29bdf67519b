//! The closed loop of one bending cell.
