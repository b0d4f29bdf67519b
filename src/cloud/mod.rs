//! Point clouds: reading scan files through one strict door, thinning, ordering, neighbours.
