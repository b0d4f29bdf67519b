//! The whole chain run against the simulators: demo and campaigns.
