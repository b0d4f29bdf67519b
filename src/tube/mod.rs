//! The vocabulary of tube bending, pure values without I/O: what a tube is, in the trade's words.
//!
//! Ground floor of the house: every other room speaks in these types. Millimetres and radians inside;
//! degrees only in serialised form ([`deg`]), where the field's name says so.

pub mod align;
pub mod deg;
mod limits;
mod lra;
mod material;
mod measured;
mod nominal;
mod polygon;
mod spine;
mod springback;
mod table;
mod ybc;

pub use limits::{MachineLimits, WholeSteps};
pub use lra::{Bend, Lra, TubeError, wrap_angle};
pub use material::Material;
pub use measured::{Decision, MeasuredBend, MeasuredTube};
pub use nominal::{Alignment, Nominal, Tolerance};
pub use polygon::{ControlPolygon, Corner, any_normal};
pub use spine::{ClosestPoint, Frame, Segment, SegmentKind, Spine, StraightPoints};
pub use springback::{SpringbackForm, SpringbackTable};
pub use table::{CommandRow, CommandTable};
pub use ybc::{Ybc, YbcRow};
