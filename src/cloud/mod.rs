//! Point clouds: reading scan files through one strict door, thinning, ordering, neighbours.
//!
//! First station of the data's way: `arm` delivers a file, [`read_scan`] turns it into a [`PointCloud`] in
//! millimetres that downstream rooms may trust (finite, no duplicates, an extent that a tube can have).

mod door;
mod duplicates;
mod error;
mod format;
mod neighbours;
mod ply;
mod point_cloud;
mod raw;
mod stream;
#[cfg(test)]
mod tests;
mod text;
mod unit;
mod voxel;
mod write;

pub use door::{Scan, parse_scan, read_scan};
pub use error::CloudError;
pub use neighbours::Neighbours;
pub use point_cloud::PointCloud;
pub use unit::Unit;
pub use write::{write_ply, write_scan, write_xyz};
