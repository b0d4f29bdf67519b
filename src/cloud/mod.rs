//! Point clouds: reading scan files through one strict door, thinning, ordering, neighbours.
//!
//! First station of the data's way: `arm` delivers a file, [`read_scan`] turns it into a [`PointCloud`] in
//! millimetres that downstream rooms may trust (finite, no duplicates, an extent that a tube can have).

mod cells;
mod door;
mod duplicates;
mod e57;
mod error;
mod format;
mod grid;
mod neighbours;
mod ply;
mod point_cloud;
mod raw;
mod stl;
mod stream;
#[cfg(test)]
mod tests;
mod text;
mod unit;
mod voxel;
mod write;

pub use door::{Scan, parse_scan, read_scan};
pub use error::CloudError;
pub use grid::Grid;
pub use neighbours::Neighbours;
pub use point_cloud::PointCloud;
pub use unit::Unit;
pub use write::{
    PlyForm, write_coloured_ply, write_e57, write_ply, write_ply_as, write_scan, write_stl, write_xyz,
};
