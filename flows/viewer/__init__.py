"""Scenes of finished runs in a browser: a live viewer, and pages that need no server."""
