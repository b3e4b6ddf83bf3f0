"""Training of FNet as flows: pairs made once and of the stated kinds, the network resumed, faults that are said."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from flows.training import fixer_job, fixer_pairs, fixer_training, scene_lists
from flows.training.curve_table import FIXER_CURVE, FIXER_SCORES, load_rows, save_rows
from flows.training.fixer_flow import train_fnet, train_pairs
from flows.training.fixer_job import CURVE_FILE, SCORES_FILE, WEIGHTS_FILE, FixerJob
from flows.training.fixer_pairs import TRAINING_PAIRS, PairRecipe, PairSet
from flows.training.fixer_training import load_pairs, train_fixer
from flows.training.requirements import check_fixer_training
from flows.training.training_scenes import SceneRecipe
from genre_tasks.config import FnetConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.fixer import training
from genre_tasks.fixer.architectures import small_architecture
from genre_tasks.fixer.training_checkpoint import CHECKPOINT_FILE
from genre_tasks.fixer.training_settings import TrainingSettings
from genre_tasks.fixer.weight_files import check_fixer_files
from genre_tasks.fixer.weights import load_fnet
from genre_tasks.stages.fnet import load_configured_fnet
from storage.files import digest_file
from tests.fixer.conftest import save_toy_sd_turbo

SMALL = "&frames=12&cameras=2&width=64&height=36&lidar_beams=16&lidar_azimuths=150"
SETS = PairRecipe(
    sets=(
        PairSet("beside", 4, "beside"),
        PairSet("under-trained", 1, "beside", early_snapshot=True),
        PairSet("sparse", 2, "unseen", keep_every=2),
        PairSet("cross-camera", 1, "camera"),
        PairSet("perturbed", 2, "beside", perturbation=(0.3, 1.0)),
    ),
    iterations=6,
)
SETTINGS = TrainingSettings(
    autoencoder_steps=2, autoencoder_batch=1, steps=4, batch=1, crop=(32, 48), warmup=2, checkpoint_every=2
)


def tiny_scene(seed: int) -> SceneRecipe:
    uri = f"synthetic:street?seed={seed}{SMALL}"
    return SceneRecipe(uri, max_points=200, distant_count=20, width_px=64, height_px=36, every=4, novel_every=1000)


def tiny_scenes(count: int, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    return [tiny_scene(k) for k in range(count)]


@pytest.fixture(scope="module", autouse=True)
def prefect() -> Iterator[None]:
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=120):
        yield


def make_tiny(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(scene_lists, "list_dense_scenes", tiny_scenes)
    patch.setattr(fixer_pairs, "TRAINING_PAIRS", SETS)
    patch.setattr(fixer_training, "VALIDATION_PAIRS", PairRecipe(sets=(PairSet("side", 1, "side"),), iterations=6))
    patch.setattr(fixer_training, "list_validation_scenes", lambda: [tiny_scene(900)])
    further = replace(SETTINGS, steps=2)
    patch.setattr(fixer_job, "PRESETS", {"small": SETTINGS, "further": further, "last": further, "paper": SETTINGS})
    patch.setattr(fixer_training, "small_architecture", lambda: small_architecture((8, 8, 16, 16), 4, (16, 16)))


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    make_tiny(monkeypatch)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[dict[str, Any]]]:
    """A folder with pairs and a training, and what the flows said, each called twice."""
    folder = tmp_path_factory.mktemp("training")
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        results = [train_pairs(str(folder), None, 2) for _ in range(2)]
        results += [train_fnet(str(folder), None, 2, validate=True) for _ in range(2)]
    return folder, results


def test_pairs_are_of_the_stated_kinds_and_made_once(trained) -> None:
    folder, results = trained
    assert results[0] == results[1]
    assert (results[0]["scenes"], results[0]["pairs"]) == (2, 20)
    found = results[0]["shares"]
    assert found["beside"] == pytest.approx(0.4) and found["perturbed"] == pytest.approx(0.2)
    assert found["optimiser"] == pytest.approx(0.8) and found["lateral"] == pytest.approx(0.7)
    artifacts = list(folder.glob("store/**/pairs/*/pairs.parquet"))
    assert len(artifacts) == 3  # two training scenes, one of validation


def test_pairs_are_the_same_when_made_again(trained, tmp_path) -> None:
    folder, _ = trained
    one = load_pairs(FixerJob(str(folder), streets=1))
    again = load_pairs(FixerJob(str(tmp_path), streets=1))
    assert one.kinds == again.kinds and np.array_equal(one.shift_m, again.shift_m)
    assert (one.views.color == again.views.color).all() and (one.truth == again.truth).all()
    lateral = [kind in ("beside", "under-trained", "perturbed") for kind in one.kinds]
    assert lateral == [shift != 0 for shift in one.shift_m.tolist()]


def test_the_shipped_recipe_has_the_shares_that_were_asked_for() -> None:
    counts = {s.kind: s.count for s in TRAINING_PAIRS.sets}
    total = sum(counts.values())
    assert counts["perturbed"] / total <= 0.4  # real optimiser output: at least 40 %, here all but the perturbed
    assert (counts["beside"] + counts["under-trained"]) / total >= 0.2  # true lateral shifts


def test_a_fixer_is_trained_once_with_its_curve_scores_and_pictures(trained) -> None:
    folder, results = trained
    assert results[2] == results[3] == {"weights": str(folder / "fnet" / "fnet.safetensors")}
    load_fnet(folder / "fnet")
    rows = load_rows(folder / "fnet" / CURVE_FILE, FIXER_CURVE)
    assert [row["step"] for row in rows] == [0, 1, 2, 3]
    assert any(row["loss"] > 0 for row in rows)  # an untrained fixer leaves a clean crop alone: its loss is 0
    scores = load_rows(folder / "fnet" / SCORES_FILE, FIXER_SCORES)
    assert [row["step"] for row in scores] == [2, 4] and all(row["psnr_identity"] > 20 for row in scores)
    assert {p.name for p in (folder / "fnet").glob("sample-*.png")} == {"sample-000002.png", "sample-000004.png"}


def test_a_stopped_training_resumes_to_the_same_bytes(trained, tmp_path, monkeypatch) -> None:
    folder, _ = trained
    (tmp_path / "store").symlink_to(folder / "store")

    class StoppedError(Exception):
        pass

    def stop(done: int, total: int, note: str = "") -> None:
        if "loss" in note and done == 5:
            raise StoppedError

    job = FixerJob(str(tmp_path), streets=2)
    with pytest.raises(StoppedError):
        train_fixer(job, stop)
    assert len(load_rows(tmp_path / "fnet" / CURVE_FILE, FIXER_CURVE)) == 2
    assert train_fixer(job) == (tmp_path / "fnet" / "fnet.safetensors", True)
    assert len(load_rows(tmp_path / "fnet" / CURVE_FILE, FIXER_CURVE)) == 4
    assert digest_file(tmp_path / "fnet" / "fnet.safetensors") == digest_file(folder / "fnet" / "fnet.safetensors")


def test_fewer_inputs_have_a_folder_of_their_own_and_the_same_autoencoder(trained) -> None:
    folder, _ = trained
    before = digest_file(folder / "fnet" / "autoencoder.pt")
    weights = Path(train_fnet(str(folder), None, 2, "render+reference")["weights"])
    assert weights == folder / "fnet-render+reference" / "fnet.safetensors"
    assert load_fnet(weights).architecture.inputs == ("render", "reference")
    assert not weights.with_name("autoencoder.pt").exists()
    assert digest_file(folder / "fnet" / "autoencoder.pt") == before
    with pytest.raises(InputError, match="other inputs"):
        train_fixer(FixerJob(str(folder), streets=2, inputs="render+lidar", start=str(weights)))


def test_what_is_trained_is_not_taken_for_another_training(trained, tmp_path) -> None:
    folder, _ = trained
    shutil.copytree(folder / "fnet", tmp_path / "fnet")
    (tmp_path / "store").symlink_to(folder / "store")
    weights = tmp_path / "fnet" / "fnet.safetensors"
    before = digest_file(weights)
    weights.unlink()
    assert train_fixer(FixerJob(str(tmp_path), streets=2)) == (weights, False)
    assert digest_file(weights) == before
    with pytest.raises(InputError, match=r"other settings: steps \(file .*fixer\.pt"):
        train_fnet(str(tmp_path), None, 2, steps=2)
    with pytest.raises(InputError, match=r"other pairs \(file .*autoencoder\.pt"):
        train_fnet(str(tmp_path), None, 1)


@pytest.mark.parametrize("name", ["fnet.safetensors", "fnet.json"])
def test_damaged_weights_come_from_the_checkpoint(trained, tmp_path, name) -> None:
    folder, _ = trained
    shutil.copytree(folder / "fnet", tmp_path / "fnet")
    (tmp_path / "store").symlink_to(folder / "store")
    damaged = tmp_path / "fnet" / name
    content = damaged.read_bytes()
    damaged.write_bytes(content[:-9])
    assert train_fixer(FixerJob(str(tmp_path), streets=2)) == (tmp_path / "fnet" / "fnet.safetensors", False)
    assert damaged.read_bytes() == content


def test_scores_of_a_deleted_training_are_not_mixed_in(trained, tmp_path) -> None:
    (tmp_path / "store").symlink_to(trained[0] / "store")
    rows = load_rows(trained[0] / "fnet" / SCORES_FILE, FIXER_SCORES)
    save_rows(tmp_path / "fnet" / SCORES_FILE, FIXER_SCORES, [{**rows[0], "step": 1}])
    train_fixer(FixerJob(str(tmp_path), streets=2, validate=True))
    assert load_rows(tmp_path / "fnet" / SCORES_FILE, FIXER_SCORES) == rows


def test_adapters_name_sd_turbo_so_that_a_run_finds_it(trained, tmp_path, monkeypatch) -> None:
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "store").symlink_to(trained[0] / "store")
    save_toy_sd_turbo(tmp_path / "turbo")
    monkeypatch.chdir(tmp_path)
    job = FixerJob("training", streets=2, preset="paper", start="turbo")
    weights, is_trained = train_fixer(job)
    assert is_trained
    config = FnetConfig(model="sd-turbo", weights=str(tmp_path / weights))
    described = weights.with_suffix(".json")
    written = described.read_text()
    # Older weights have the path as it was typed: the same command mends them.
    described.write_text(json.dumps({**json.loads(written), "base": "turbo"}))
    with pytest.raises(InputError, match=r"SD-Turbo \(turbo\) is not on this machine"):
        check_fixer_files(config)
    assert train_fixer(job) == (weights, False)
    assert described.read_text() == written
    monkeypatch.chdir(trained[0])
    assert check_fixer_files(config) == tmp_path / weights
    load_configured_fnet(config)


def test_adapters_with_an_absolute_path_may_be_copied_and_stay_as_they_are(trained, tmp_path, monkeypatch) -> None:
    (tmp_path / "training").mkdir()
    (tmp_path / "training" / "store").symlink_to(trained[0] / "store")
    save_toy_sd_turbo(tmp_path / "turbo")
    monkeypatch.chdir(tmp_path)
    job = FixerJob("training", streets=2, preset="paper", start=str(tmp_path / "turbo"))
    weights, _ = train_fixer(job)
    copied = tmp_path / "elsewhere" / "deeper" / "adapters"
    shutil.copytree(weights.parent, copied)
    assert check_fixer_files(FnetConfig(model="sd-turbo", weights=str(copied))) == copied / WEIGHTS_FILE
    # Trained by a version that wrote every path as it was typed, and started now by a relative path.
    described = weights.with_suffix(".json")
    written = described.read_text()
    assert json.loads(written)["base"] == str(tmp_path / "turbo")
    assert train_fixer(replace(job, start="turbo")) == (weights, False)
    assert described.read_text() == written
    # The same folder, named relative to the adapters.
    relative = json.dumps({**json.loads(written), "base": "../../turbo"})
    described.write_text(relative)
    assert train_fixer(job) == (weights, False) and described.read_text() == relative
    # No run finds a folder that is gone.
    described.write_text(json.dumps({**json.loads(written), "base": str(tmp_path / "gone")}))
    assert train_fixer(job) == (weights, False) and described.read_text() == written


def test_a_kill_at_the_last_checkpoint_loses_no_weights(trained, tmp_path, monkeypatch) -> None:
    folder, _ = trained
    (tmp_path / "store").symlink_to(folder / "store")
    job, save = FixerJob(str(tmp_path), streets=2), training.save_checkpoint

    def killed(state, *where) -> None:
        save(state, *where)
        if state.step == SETTINGS.steps:
            raise KeyboardInterrupt

    monkeypatch.setattr(training, "save_checkpoint", killed)
    with pytest.raises(KeyboardInterrupt):
        train_fixer(job)
    monkeypatch.undo()
    make_tiny(monkeypatch)
    weights, trained_anew = train_fixer(job)
    assert not trained_anew and digest_file(weights) == digest_file(folder / "fnet" / "fnet.safetensors")


def test_fewer_inputs_may_be_trained_first(trained, tmp_path) -> None:
    (tmp_path / "store").symlink_to(trained[0] / "store")
    weights, _ = train_fixer(FixerJob(str(tmp_path), streets=2, inputs="reference+lidar"))
    assert load_fnet(weights).architecture.inputs == ("reference", "lidar")
    assert (tmp_path / "fnet" / "autoencoder.pt").is_file()


def test_a_fixer_is_trained_further_in_a_folder_of_its_own(trained) -> None:
    folder, _ = trained
    weights = Path(train_fnet(str(folder), None, 2, preset="further")["weights"])
    assert weights == folder / "fnet-further" / "fnet.safetensors"
    before, after = (load_fnet(folder / name).state_dict() for name in ("fnet", "fnet-further"))
    assert torch.equal(before["vae.encoder.conv_in.weight"], after["vae.encoder.conv_in.weight"])
    assert not torch.equal(before["skips.0.weight"], after["skips.0.weight"])
    last = Path(train_fnet(str(folder), None, 2, preset="last")["weights"])
    assert last == folder / "fnet-last" / "fnet.safetensors"
    assert not torch.equal(load_fnet(last.parent).state_dict()["skips.0.weight"], after["skips.0.weight"])


def test_an_unfinished_fixer_is_not_trained_further(trained, tmp_path: Path) -> None:
    shutil.copytree(trained[0] / "fnet", tmp_path / "fnet")
    checkpoint = tmp_path / "fnet" / CHECKPOINT_FILE
    stored = torch.load(checkpoint, weights_only=True)
    torch.save({**stored, "step": stored["step"] - 1}, checkpoint)
    with pytest.raises(InputError, match=r"has made \d+ of \d+ steps.*--start"):
        check_fixer_training(FixerJob(str(tmp_path), streets=2, preset="further"))
    # Weights that the user names are taken as they are.
    check_fixer_training(FixerJob(str(tmp_path), streets=2, preset="further", start=str(tmp_path / "fnet")))


def test_faults_are_said(monkeypatch) -> None:
    with pytest.raises(ConfigError, match="no input is called radar"):
        FixerJob("x", inputs="render+radar")
    with pytest.raises(ConfigError, match="no preset is called"):
        FixerJob("x", preset="huge")
    with pytest.raises(ConfigError, match="starts from SD-Turbo"):
        FixerJob("x", preset="paper")
    with pytest.raises(ConfigError, match="given all inputs"):
        FixerJob("x", preset="paper", start="sd-turbo", inputs="render")
    with pytest.raises(ConfigError, match="nothing to make pairs of"):
        train_pairs("x", None, 0)
    monkeypatch.setattr(
        scene_lists, "list_dense_scenes", lambda *_: [replace(tiny_scene(1), uri="synthetic:street?seed=1001")]
    )
    with pytest.raises(ConfigError, match="seed 1001"):
        train_pairs("x", None, 1)
