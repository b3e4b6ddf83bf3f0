"""Presets, files and ``--set`` merged into one checked configuration; unknown keys answer with "did you mean"."""

from __future__ import annotations

from flows.configuration.key_tables import REMOVED_KEYS, RENAMED_KEYS
from flows.configuration.loading import PRESETS, apply_settings, diff_from_preset, load_configuration, read_preset
from flows.configuration.validation import validate_config

__all__ = [
    "PRESETS",
    "REMOVED_KEYS",
    "RENAMED_KEYS",
    "apply_settings",
    "diff_from_preset",
    "load_configuration",
    "read_preset",
    "validate_config",
]
