"""LiDAR sweeps of a scene: the sensor's own pattern of rays, cast through the Gaussians, compared with real sweeps."""
