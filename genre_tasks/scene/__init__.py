"""Chunks, Gaussians and the scene graph."""
