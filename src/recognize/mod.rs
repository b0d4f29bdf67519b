//! Local geometry in a cloud: jets (normals, shape operator); later planes and surfaces of revolution.
