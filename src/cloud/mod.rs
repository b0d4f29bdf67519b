//! Point clouds: reading scan files through one strict door, thinning, ordering, neighbours.
//!
//! First station of the data's way: `arm` delivers a file, [`read_scan`] turns it into a [`PointCloud`] in
//! millimetres that downstream rooms may trust (finite, no duplicates, an extent that a tube can have).

mod neighbours;
mod point_cloud;
mod voxel;

pub use neighbours::Neighbours;
pub use point_cloud::PointCloud;
