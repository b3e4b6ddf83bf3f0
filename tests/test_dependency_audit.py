"""No installed package has a known vulnerability, as far as the advisory service answers; part of ``make test-all``."""

from __future__ import annotations

import json
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow
AUDIT = Path(__file__).resolve().parents[1] / "build/audit/bin/pip-audit"


def list_vulnerable(report: dict[str, Any]) -> list[str]:
    """Name, version, advisory and mended versions of each vulnerable package."""
    return [
        f"{package['name']} {package['version']}: {advisory['id']}, mended in {advisory['fix_versions']}"
        for package in report["dependencies"]
        for advisory in package.get("vulns", ())
    ]


def test_a_vulnerable_package_is_listed() -> None:
    bad = {"name": "a", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2"]}]}
    assert list_vulnerable({"dependencies": [{"name": "b", "version": "1", "vulns": []}, bad]}) == [
        "a 1: PYSEC-1, mended in ['2']"
    ]


def test_no_package_has_a_known_vulnerability() -> None:
    if not AUDIT.is_file():
        pytest.skip("not checked: make test-all installs pip-audit")
    command = [AUDIT, "--path", sysconfig.get_path("purelib"), "--format", "json", "--progress-spinner", "off"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    try:
        report = json.loads(done.stdout)
    except ValueError:
        # A test that cannot reach the service has checked nothing, and must not count as one that holds.
        pytest.skip(f"not checked: {done.stderr[-500:]}")
    assert not list_vulnerable(report)
    unknown = [package["name"] for package in report["dependencies"] if "skip_reason" in package]
    if len(unknown) > len(report["dependencies"]) / 2:
        pytest.skip(f"not checked: the service knows {len(unknown)} of {len(report['dependencies'])} packages not")
