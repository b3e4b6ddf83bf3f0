"""Keys depend on code, settings and inputs, and on nothing of the machine or the folder that they are computed in."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights, digest_weights, stage_key
from genre_tasks.config import PipelineConfig
from genre_tasks.weights import list_weights_files, resolve_weights

ROOT = Path(__file__).resolve().parents[2]
LITTER = (".DS_Store", "._fnet.safetensors", "Thumbs.db", "desktop.ini", "README.md", "fnet.safetensors.part")

_KEYS = """
import json, sys
from flows.pipeline.definition import PIPELINE, digest_stage_weights, stage_key
from flows.configuration import load_configuration
from genre_tasks.logs.registry import open_log
config = load_configuration("small", settings=["initial.opacity=0.3333333333333333"])
log = open_log("synthetic:street?seed=7&frames=8&noise_m=0.1")
inputs = {"log": log.digest(), "chunk": "0"}
sys.stdout.write(json.dumps([
    stage_key(spec, config, inputs, digest_stage_weights(spec, config), (type(log).__module__,)) for spec in PIPELINE
]))
"""


def key(stage: str, settings: dict[str, Any]) -> str:
    spec = STAGE_BY_NAME[stage]
    config = PipelineConfig.model_validate({spec.section: settings})
    return stage_key(spec, config, {}, digest_stage_weights(spec, config))


def test_keys_do_not_depend_on_the_environment(tmp_path: Path) -> None:
    """Report: marimo-team/marimo#9829 (cache keys differ with the seed of hashes)."""
    environments = (
        {"PYTHONHASHSEED": "1", "TZ": "UTC", "LC_ALL": "C", "OMP_NUM_THREADS": "1", "GENRE_RENDER_ISA": "sse42"},
        {
            "PYTHONHASHSEED": "2",
            "TZ": "Asia/Kathmandu",
            "LC_ALL": "de_DE.UTF-8",
            "PYTHONUTF8": "0",
        },
    )
    runs = []
    for k, environment in enumerate(environments):
        (folder := tmp_path / f"{k} ä").mkdir()
        passed = os.environ | environment | {"PYTHONPATH": str(ROOT), "HOME": str(folder)}
        command = [sys.executable, "-c", _KEYS]
        runs.append(subprocess.run(command, env=passed, cwd=folder, capture_output=True, text=True, timeout=60))
    assert runs[0].stdout == runs[1].stdout and len(set(json.loads(runs[0].stdout))) == 11, runs[1].stderr


@pytest.fixture
def fixer(tmp_path: Path) -> Path:
    """The built-in fixer in a folder, as training writes it."""
    folder = tmp_path / "trained" / "fixer"
    folder.mkdir(parents=True)
    for file in list_weights_files(resolve_weights("fnet", "builtin")).values():
        shutil.copy(file, folder / f"fnet{file.suffix}")
    return folder


def test_weights_count_by_content_and_not_by_place_or_name(fixer: Path, tmp_path: Path) -> None:
    builtin = key("fnet", {})
    assert key("fnet", {"weights": str(fixer)}) == builtin
    assert key("fnet", {"weights": str(fixer / "fnet.safetensors")}) == builtin
    for file in fixer.iterdir():
        file.rename(tmp_path / f"renamed{file.suffix}")
    assert key("fnet", {"weights": str(tmp_path / "renamed.safetensors")}) == builtin
    with (tmp_path / "renamed.safetensors").open("ab") as tensors:
        tensors.write(b"\0")
    assert key("fnet", {"weights": str(tmp_path / "renamed.safetensors")}) != builtin


def test_weights_of_a_refinement_count_by_content(tmp_path: Path) -> None:
    files = list_weights_files(resolve_weights("enet", "builtin"))
    for file in files.values():
        shutil.copy(file, tmp_path / f"mine{file.suffix}")
    mine = {"refine": {"weights": str(tmp_path / "mine.safetensors")}}
    assert key("gnet", {"refine": {}}) == key("gnet", mine) != key("gnet", {"refine": {"weights": "builtin:gnet"}})
    assert key("gnet", {"refine": {}}) != key("gnet", {})


def test_weights_that_a_method_does_not_load_do_not_count() -> None:
    assert key("gnet", {"method": "adam"}) == key("gnet", {"method": "adam", "weights": "builtin:enet"})
    assert key("gnet", {}) != key("gnet", {"weights": "builtin:enet"})


def test_litter_in_a_folder_of_weights_changes_nothing(fixer: Path) -> None:
    """Report: tuist/tuist#8842 (.DS_Store changes the hash of a folder)."""
    before = digest_weights(fixer)
    for name in LITTER:
        (fixer / name).write_bytes(b"\0\5\x16\7")
    (fixer / "checkpoints").mkdir()
    (fixer / "checkpoints" / "fnet.safetensors").write_bytes(b"")
    assert digest_weights(fixer) == before


def test_line_endings_of_a_configuration_change_nothing(fixer: Path) -> None:
    """Report: actions/runner#1246 (a checkout with CRLF has other hashes)."""
    before, file = digest_weights(fixer), fixer / "fnet.json"
    document = json.loads(file.read_bytes())
    file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n"))
    assert digest_weights(fixer) == before
    file.write_text(json.dumps(document | {"model": "other"}))
    changed = digest_weights(fixer)
    file.write_text("no JSON")
    assert len({before, changed, digest_weights(fixer)}) == 3


@pytest.mark.parametrize("base", ["sd-turbo", "../base"])
def test_the_model_that_weights_are_based_on_counts(fixer: Path, base: str) -> None:
    (fixer / "fnet.json").write_text(json.dumps({"model": "sd-turbo", "base": base}))
    digests = [digest_weights(fixer)]
    for part in ("vae", "unet"):
        (folder := fixer / base / part).mkdir(parents=True)
        for name in ("config.json", "diffusion_pytorch_model.safetensors"):
            (folder / name).write_text("{}")
            digests.append(digest_weights(fixer))
    (fixer / base / "unet/diffusion_pytorch_model.safetensors").write_text("{1}")
    digests.append(digest_weights(fixer))
    assert len(set(digests)) == 6
    for name in (*LITTER, "._diffusion_pytorch_model.safetensors"):
        (fixer / base / "unet" / name).write_bytes(b"\0")
    assert digest_weights(fixer) == digests[-1]


def test_a_file_that_a_setting_names_counts_by_content(tmp_path: Path) -> None:
    one, two = tmp_path / "one.ply", tmp_path / "two.ply"
    one.write_text("ply")
    two.write_text("ply")
    same = key("ingest", {"points": str(one)})
    assert key("ingest", {"points": str(two)}) == same
    two.write_text("other")
    assert key("ingest", {"points": str(two)}) != same != key("ingest", {})


def test_the_name_of_a_network_is_no_files_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    before = key("evaluate/gnet", {"lpips": "alex"})
    (tmp_path / "alex").write_text("a network")
    assert key("evaluate/gnet", {"lpips": "alex"}) == before
    of_the_file = key("evaluate/gnet", {"lpips": "./alex"})
    assert len({before, of_the_file, key("evaluate/gnet", {"lpips": "vgg"}), key("evaluate/gnet", {})}) == 4
