"""What the command sets for its runs, set for the tests too: see ``flows.cli.main.prepare_environment``."""

from __future__ import annotations

import os

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("DO_NOT_TRACK", "1")
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")

# Doctests are collected from every module, and several conftest.py of one name cannot be imported as modules.
collect_ignore_glob = ["conftest.py", "*/conftest.py"]
