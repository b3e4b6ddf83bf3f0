"""AlpaSim and NuRec: images for a simulator over gRPC, and the bundle that tells it of the scene."""
