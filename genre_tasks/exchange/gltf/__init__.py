"""glTF 2.0 in one file (GLB) with KHR_gaussian_splatting: a scene with moving actors in an open format."""
