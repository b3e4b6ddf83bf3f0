"""Per-scene 3D Gaussian Splatting, the baseline that the learned optimiser is compared with."""
