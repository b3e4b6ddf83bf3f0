"""``genre import``: an error for each mistake, and for each document of somebody else that is no scene."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flows.exchange.export_request import ExportRequest
from flows.exchange.export_scenes import export_scenes
from flows.exchange.import_scene import import_scene
from genre_tasks.errors import ConfigError, GenreError, InputError
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.registry import load_format
from genre_tasks.exchange.scene_folder import SCENE_FILE
from tests.exchange.splat_clouds import make_cloud
from tests.flows.small_simulation import make_run


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> ExportRequest:
    """A run of two chunks, to be exported as PLY."""
    store = tmp_path_factory.mktemp("exchange")
    return ExportRequest(store=str(store), scene=make_run(store), format="ply", out=store / "unused")


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("none.ply", None, "no such file"),
        ("scene.obj", "", "no known suffix"),
        ("scene.ply", "not a ply", "PLY|ply"),
        ("scene.usda", "not a layer", "OpenUSD cannot read"),
    ],
)
def test_mistakes_of_imports_are_named(tmp_path: Path, name: str, text: str | None, words: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        import_scene(str(tmp_path / "store"), tmp_path / name)
    assert caught.value.file == str(tmp_path / name)
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize("name", ["", ".hidden", "a/b", "../x", "a\nb"])
def test_names_that_cannot_be_folders_are_refused(tmp_path: Path, name: str) -> None:
    load_format("ply").write(tmp_path / "scene.ply", make_resting_scene(make_cloud(300, 3)))
    with pytest.raises(ConfigError, match="--name"):
        import_scene(str(tmp_path / "store"), tmp_path / "scene.ply", name)


def damage(document: dict[str, Any], path: str, value: object) -> None:
    """Sets an entry that is named as ``chunks.0.times_s``."""
    *parents, last = path.split(".")
    at: Any = document
    for part in parents:
        at = at[int(part)] if isinstance(at, list) else at[part]
    at[int(last) if isinstance(at, list) else last] = value


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("kind", "thesis", "describes no scene"),
        ("version", 9, "version 9"),
        ("format", "obj", "unknown format"),
        ("chunks", [], "no chunk"),
        ("chunks.0.times_s", [0.0, 0.0], "moments of chunk 0"),
        ("chunks.0.frames", [1], "moments of chunk 0"),
        ("chunks.0.frames.0", 10**30, "frames"),
        ("chunks.0.times_s.0", 1e999, "no number of JSON|cannot be read"),
        ("chunks.0.world_SE3_scene", [[1]], "world_SE3_scene"),
        ("chunks.0.nodes.0.file", "../secret.ply", "no file"),
        ("chunks.0.nodes.0.file", "/etc/hostname", "no file"),
        ("chunks.0.nodes.0.file", None, "no file"),
        ("chunks.0.nodes.1.name", "background", "one name"),
        ("files.0.path", "../../x", "no file"),
        ("layout", "heap", "layout"),
    ],
)
def test_documents_of_others_are_checked(
    run: ExportRequest, tmp_path: Path, path: str, value: object, words: str
) -> None:
    out = tmp_path / "out"
    export_scenes(replace(run, out=out, chunks=(0,)))
    document = json.loads((out / SCENE_FILE).read_text())
    damage(document, path, value)
    (out / SCENE_FILE).write_text(json.dumps(document))
    with pytest.raises(GenreError, match=words):
        import_scene(str(tmp_path / "store"), out)
