"""What the command sets for its runs, set for the tests too: see ``flows.cli.main.prepare_environment``."""

from __future__ import annotations

import gc
import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("DO_NOT_TRACK", "1")
# A server of gRPC in this process would break programs that tests start, such as the encoder of films.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "false")
os.environ.setdefault("PREFECT_SERVER_ANALYTICS_ENABLED", "false")
# Workers of pytest-xdist share the cores: threads of each for all of them would take a fifth more of their time.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    share = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max(share, 1)))
# The user's own caches are none of the tests' business.
os.environ.setdefault("GENRE_CACHE_DIR", str(Path(__file__).resolve().parents[1] / "build/tests/cache"))

# Doctests are collected from every module, and several conftest.py of one name cannot be imported as modules.
collect_ignore_glob = ["conftest.py", "*/conftest.py"]


def pytest_addoption(parser: pytest.Parser) -> None:
    """Options of the fault matrix, here because pytest reads them before it knows of deeper folders."""
    group = parser.getgroup("fault matrix")
    group.addoption("--write-fault-table", action="store_true", help="Write rows into the table of faults.")
    group.addoption("--fault-times", type=int, default=5, help="How often every fault is injected.")
    group.addoption("--keep-fault-folder", action="store_true", help="Leave logs and stores of the faults on the disk.")


def pytest_collection_finish() -> None:
    """Takes what thousands of collected tests hold out of every later search for garbage, one at each stage's end."""
    _freeze()


@pytest.fixture(scope="module", autouse=True)
def _modules_apart() -> None:
    """The same for what the modules of tests before this one have imported and keep."""
    _freeze()


def _freeze() -> None:
    # Garbage that is frozen would stay for good.
    gc.collect()
    gc.freeze()
