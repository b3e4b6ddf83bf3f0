"""OpenUSD: scenes of ``ParticleField3DGaussianSplat`` prims, in packages (``.usdz``) and layers."""
