"""Scenes of nuScenes, and of datasets in its layout."""
