"""Presets: YAML files that say what they change from the paper's numbers, and why."""
