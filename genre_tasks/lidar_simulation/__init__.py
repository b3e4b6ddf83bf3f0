"""LiDAR sweeps of a scene of Gaussians, and how they compare with recorded ones."""
