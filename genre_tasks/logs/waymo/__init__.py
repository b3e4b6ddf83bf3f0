"""Segments of the Waymo Open Dataset, version 2."""
