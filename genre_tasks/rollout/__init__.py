"""Rollouts: what the cameras of a rig see along an ego path through the scenes of a run."""
