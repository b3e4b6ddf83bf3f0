"""Logs of the Argoverse 2 sensor dataset."""
