"""What a training needs is checked before any work: sizes of pairs, weights to start from, the device."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flows.training import device, optimiser_stages
from flows.training.fixer_job import WEIGHTS_FILE, FixerJob
from flows.training.optimiser_stages import train_stage
from flows.training.recipes import get_recipe
from flows.training.requirements import check_fixer_training, check_optimiser_training
from flows.training.train_job import TrainJob
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.weights import resolve_weights

LOG = "synthetic:street?seed=3&frames=8&cameras=1&lidar_beams=16&lidar_azimuths=150"
"""It stands for a recorded log, whose images are of any shape."""


def test_a_real_log_of_another_shape_than_streets_is_refused_beside_them(tmp_path: Path) -> None:
    wide = FixerJob(str(tmp_path), real=f"{LOG}&width=436&height=132")
    for is_training in (False, True):
        with pytest.raises(ConfigError, match=r"436×132 pixels.* 320×180\. Give `--streets 0`, or a log of 16:9"):
            check_fixer_training(wide, is_training)
    check_fixer_training(replace(wide, streets=0))
    check_fixer_training(replace(wide, real=LOG))
    check_fixer_training(replace(wide, real=f"{LOG}&width=640&height=360"))


@pytest.mark.parametrize(
    ("preset", "before", "command"),
    [("further", "fnet", "genre train fnet"), ("last", "fnet-further", "genre train fnet --preset further")],
)
def test_weights_to_go_on_from_have_to_be_trained_first(tmp_path: Path, preset: str, before: str, command: str) -> None:
    job = FixerJob(str(tmp_path), streets=1, preset=preset)
    absent = rf"missing or damaged .*Run `{command}` first, or name weights with --start"
    with pytest.raises(InputError, match=absent):
        check_fixer_training(job)
    weights = tmp_path / before / WEIGHTS_FILE
    weights.parent.mkdir()
    for suffix in (".safetensors", ".json"):
        shutil.copy(resolve_weights("fnet", "builtin").with_suffix(suffix), weights.with_suffix(suffix))
    check_fixer_training(job)
    weights.write_bytes(weights.read_bytes()[:1000])
    with pytest.raises(InputError, match=absent):
        check_fixer_training(job)
    # Weights that the user names are not the training's before.
    with pytest.raises(InputError, match="the weights cannot be read"):
        check_fixer_training(replace(job, start=str(weights)))


def test_a_start_is_found_from_any_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "turbo").mkdir()
    absolute = str(tmp_path / "turbo")
    for start, base in (("turbo", "../../turbo"), ("~/turbo", absolute), (absolute, absolute)):
        job = FixerJob("training", preset="paper", start=start)
        assert job.sd_turbo is not None and Path(job.sd_turbo).samefile(tmp_path / "turbo")
        assert job.adapters_base == base
    by_name = FixerJob("training", preset="paper", start="stabilityai/sd-turbo")
    assert by_name.sd_turbo == by_name.adapters_base == "stabilityai/sd-turbo"
    small = FixerJob("training", start="~/fnet")
    assert small.initial_weights == tmp_path / "fnet" and small.sd_turbo is small.adapters_base is None


def test_scenes_with_effects_are_trained_on_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # As on a machine with a GPU and gsplat.
    monkeypatch.setattr(device, "_REQUIREMENTS", {})
    assert TrainJob("x").choose_device().type == "cuda"
    with pytest.raises(ConfigError, match=r"effects\. Give --device cpu"):
        check_optimiser_training(TrainJob(str(tmp_path), "effects", device="cuda"), "gnet")
    devices: list[str] = []

    def note_device(network: Any, *_: Any, **__: Any) -> None:
        devices.append(next(network.parameters()).device.type)

    monkeypatch.setattr(optimiser_stages, "load_training_scenes", lambda *_: [])
    monkeypatch.setattr(optimiser_stages, "train_optimiser", note_device)
    for stage in get_recipe("effects"):
        train_stage(TrainJob(str(tmp_path), "effects"), stage)
    # Both, or the weights would differ in more than their scenes.
    assert devices == ["cpu", "cpu"]
