"""What commands and flows take where the user names nothing; without imports, so that ``genre --help`` stays quick."""

from __future__ import annotations

DEFAULT_PRESET = "fine"
"""The preset that reconstructs a log; chosen on validation logs, see docs/guides/presets.md."""
DEFAULT_STORE = "genre-store"
"""The folder that keeps every artifact, below the current one."""
DEFAULT_IN_FLIGHT = 8
"""How many runs of a dataset are submitted to a work pool at once."""
DEFAULT_ATTEMPTS = 3
"""How often a log whose worker dies is submitted."""
