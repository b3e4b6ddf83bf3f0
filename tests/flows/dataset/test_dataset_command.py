"""``genre dataset``: what it submits to a work pool, and which options it takes without one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from typer.testing import CliRunner

from flows.cli import dataset
from flows.cli.main import app
from genre_tasks.errors import ConfigError

ANY_ID = UUID(int=0)


def test_paths_are_absolute_on_a_pool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A worker's own folder is removed after a run, so a relative store would be lost with it."""
    submitted: list[Mapping[str, Any]] = []

    def submit(name: str, parameters: Mapping[str, Any], follow: bool, as_json: bool) -> UUID:
        submitted.append(parameters)
        return ANY_ID

    monkeypatch.setattr(dataset, "_submit", submit)
    monkeypatch.chdir(tmp_path)
    logs = ["pandaset:data/002", "posed_images:t.json?images=i&scale=2", "kitti:d?labels=/l", "synthetic:street?seed=1"]
    (tmp_path / "fnet.safetensors").touch()
    sets = ["fnet.weights=fnet.safetensors", "gnet.weights=builtin", "gnet.iterations=9"]
    words = [word for setting in sets for word in ("--set", setting)]
    CliRunner().invoke(app, ["dataset", *logs, "--pool", "genre", "--store", "kept", *words], catch_exceptions=False)
    CliRunner().invoke(app, ["dataset", *logs, "--pool", "genre", "--store", "s3://bucket/x"], catch_exceptions=False)
    absolute = [
        f"pandaset:{tmp_path}/data/002",
        f"posed_images:{tmp_path}/t.json?images={tmp_path}/i&scale=2",
        f"kitti:{tmp_path}/d?labels=/l",
        "synthetic:street?seed=1",
    ]
    assert [(entry["store"], entry["logs"]) for entry in submitted] == [
        (str(tmp_path / "kept"), absolute),
        ("s3://bucket/x", absolute),
    ]
    assert submitted[0]["settings"] == [f"fnet.weights={tmp_path}/fnet.safetensors", *sets[1:]]


@pytest.mark.parametrize(
    "words", [["--follow"], ["--by", "chunk"], ["--in-flight", "99"], ["--attempts", "1"], ["--gpu-limit", "gpu"]]
)
def test_options_of_a_pool_need_one(words: list[str]) -> None:
    with pytest.raises(ConfigError, match=f"{words[0]} is for a dataset on a pool"):
        CliRunner().invoke(app, ["dataset", "synthetic:street?seed=1", *words], catch_exceptions=False)


def test_files_in_settings_are_absolute_without_a_pool_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Mapping[str, Any]] = []
    monkeypatch.setattr(dataset, "_run_here", lambda parameters, facts, as_json: asked.append(parameters))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "p.ply").touch()
    words = ["--set", "ingest={points: p.ply}", "--set", "gnet.iterations=9"]
    CliRunner().invoke(app, ["dataset", "synthetic:street?seed=1", *words], catch_exceptions=False)
    assert [entry["settings"] for entry in asked] == [[f'ingest={{"points": "{tmp_path}/p.ply"}}', "gnet.iterations=9"]]
