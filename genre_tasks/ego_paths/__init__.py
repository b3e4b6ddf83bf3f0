"""Paths of the ego vehicle: the recorded one, and other behaviours that branch from it."""
