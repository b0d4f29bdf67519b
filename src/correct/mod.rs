//! Deviations to the next bending table: spring-back, limits, verdicts.
