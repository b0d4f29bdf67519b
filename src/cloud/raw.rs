//! What stands between the readers and the door: a file's content before it is judged.

use nalgebra::Point3;

/// What a reader hands to the door: points in the file's unit, normals where the file has them.
#[derive(Debug, Default)]
pub(super) struct Raw {
    pub points: Vec<Point3<f64>>,
    pub normals: Option<Vec<[f32; 3]>>,
    pub notes: Vec<String>,
}
