//! benderd closes the loop on CNC tube bending. The data flows one way:
//!
//! ```text
//! arm ──► cloud ──► reconstruct ──► inspect ──► correct ──► bender
//! (scan)  (points)  (tube, LRA)    (deviations) (table)    (stage, verify, commit)
//!              └────────────── cell: one state machine drives it, journal records it ──────────┘
//! ```
//!
//! `tube` is the vocabulary, `report` what a person judges a measurement by, `sim` stands in for the hardware, `trial`
//! runs the whole chain against it, `cli` is the face. Rooms from `tube` to `correct` are pure. ARCHITECTURE.md is the map.

pub mod arm;
pub mod bender;
pub mod cell;
pub mod cli;
pub mod cloud;
pub mod config;
pub mod correct;
pub mod inspect;
pub mod journal;
pub mod recognize;
pub mod reconstruct;
pub mod report;
pub mod sim;
pub mod trial;
pub mod tube;
