"""Guides name the variables of the environment that there are, with the defaults of the code."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from flows.dataset.supervisor import PENDING_VARIABLE, SILENT_VARIABLE, read_limits
from genre_tasks.cache_folder import FOLDER_VARIABLE, find_cache_folder
from storage.objects import object_lease
from storage.objects.client import RETRY_VARIABLE, read_retry_seconds
from storage.objects.object_lease import LEASE_VARIABLE
from storage.objects.read_cache import LIMIT_VARIABLE, read_limit_bytes

GUIDES = Path(__file__).resolve().parents[2] / "docs/guides"
ROW = re.compile(r"^\| `(GENRE_\w+)` \|.*\| `?([^|`]+?)`? \|$", re.MULTILINE)


def test_the_guide_to_deployment_has_the_defaults_of_a_supervisor() -> None:
    limits = read_limits(1, 1, {})
    defaults = {SILENT_VARIABLE: limits.silent_s, PENDING_VARIABLE: limits.pending_s}
    rows = dict(ROW.findall((GUIDES / "deployment.md").read_text()))
    assert {name: float(text) for name, text in rows.items()} == defaults


def test_the_guide_to_stores_has_the_defaults_of_a_bucket(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in (FOLDER_VARIABLE, LIMIT_VARIABLE, RETRY_VARIABLE, "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    rows = dict(ROW.findall((GUIDES / "stores.md").read_text()))
    assert Path(rows.pop(FOLDER_VARIABLE)).expanduser() == find_cache_folder()
    assert {name: float(text) for name, text in rows.items()} == {
        LIMIT_VARIABLE: read_limit_bytes() / 1e9,
        LEASE_VARIABLE: object_lease._LEASE_S,
        RETRY_VARIABLE: read_retry_seconds(),
    }
