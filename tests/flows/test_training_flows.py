"""Training as flows: stages in their order, scenes made once, stop and resume, faults that are said."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from flows.machine.folder_lock import hold_training_folder
from flows.training import recipes, scene_lists, stage_scenes, training_scenes, validation
from flows.training.curve_table import LEARNING_CURVE, VALIDATION_SCORES, load_rows
from flows.training.fixed_images import FixedImages
from flows.training.optimiser_flow import train_network, train_scenes
from flows.training.optimiser_stages import train_stage
from flows.training.scene_lists import SceneList
from flows.training.scene_starts import Adam, ByGnet, Initial, PerScene
from flows.training.stage_recipe import Stage
from flows.training.stage_scenes import list_stage_scenes
from flows.training.train_job import TrainJob
from flows.training.training_scenes import SceneRecipe, build_training_scene, prepare_scene
from genre_tasks.config import LossConfig
from genre_tasks.errors import ArtifactCorruptError, ConfigError, InputError
from genre_tasks.learned.meta_training import MetaConfig
from genre_tasks.learned.network import NetworkConfig
from genre_tasks.learned.weights import load_optimiser
from genre_tasks.optimiser.tuned_adam import GNET_LEARNING_RATES
from storage.files import digest_file
from storage.local import LocalStore
from storage.store import Artifact
from tests.contracts.store_suite import address
from tests.storage.artifact_values import assert_same, make

SMALL = "&frames=8&cameras=1&width=32&height=18&lidar_beams=16&lidar_azimuths=150"
NETWORK = NetworkConfig(hidden=8, channels=(4, 6), rates=GNET_LEARNING_RATES.as_tuple())
PLAIN = LossConfig(perceptual=0.0)
CONFIG = MetaConfig(
    steps=3, segment=2, pool=2, iterations=(4,), views=(2,), novel_views=1, warm_up=2, loss=PLAIN, held_out_loss=PLAIN
)
TWO = SceneList("coarse", 2)
AGES = (Adam(2), PerScene(2, 4), PerScene(4, 4))
TABLE = (
    Stage("enet/3dgs", None, NETWORK, replace(TWO, rounds=2), CONFIG, AGES, FixedImages("fnet")),
    Stage("gnet/only", "enet/3dgs", NETWORK, TWO, CONFIG.model_copy(update={"seed": 1})),
    Stage(
        "enet/gnet",
        "enet/3dgs",
        NETWORK,
        TWO,
        CONFIG,
        (ByGnet("gnet/only", 2, 2), Adam(2)),
        FixedImages("stand_in", Initial()),
    ),
)
"""The paper's order."""


Trained = tuple[Path, list[dict[str, Any]]]


def tiny_scenes(count: int, real: str | None = None, times: int = 1) -> list[SceneRecipe]:
    return [
        SceneRecipe(f"synthetic:street?seed={k}{SMALL}", max_points=150, distant_count=20, width_px=32, height_px=18)
        for k in range(count)
    ]


@pytest.fixture(scope="module", autouse=True)
def prefect() -> Iterator[None]:
    from prefect.testing.utilities import prefect_test_harness

    with prefect_test_harness(server_startup_timeout=120):
        yield


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    make_tiny(monkeypatch)


def make_tiny(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(scene_lists, "list_coarse_scenes", tiny_scenes)
    patch.setattr(recipes, "RECIPES", {"tiny": TABLE})
    patch.setattr(validation, "SEEDS", (900,))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    """A folder with everything trained in the paper's order, and what the flows said, each called twice."""
    folder = tmp_path_factory.mktemp("training")
    with pytest.MonkeyPatch.context() as patch:
        make_tiny(patch)
        results: list[dict[str, Any]] = [train_scenes(str(folder), "tiny"), train_scenes(str(folder), "tiny")]
        results.append(train_network("gnet", str(folder), "tiny", save_every=2, validate_every=2))
        results.append(train_network("enet", str(folder), "tiny"))
    return folder, results


def test_scenes_are_made_once(trained: Trained) -> None:
    folder, (first, second, *_) = trained
    # Of each chunk: itself, its start, its truth; two ages, and FNet's images of both. One has Adam's for ENet's end.
    kinds = sorted(path.parent.parent.name for path in (folder / "store").glob("synthetic/*/0000/**/manifest.json"))
    assert first["scenes"] == second["scenes"] == 2
    assert first["made"] > 10 and second["made"] == 0
    assert {"ingest", "initial", "truth", "adam", "standard_3dgs", "fnet"} <= set(kinds)


def test_stages_are_trained_in_their_order_and_once(trained: Trained) -> None:
    folder, (*_, gnet, enet) = trained
    assert gnet["stages"] == [("enet/3dgs", False), ("gnet/only", False)]
    assert enet["stages"] == [("enet/3dgs", True), ("gnet/only", True), ("enet/gnet", False)]
    for network, last in ((gnet, "gnet/only"), (enet, "enet/gnet")):
        assert digest_file(Path(network["weights"])) == digest_file(folder / last / "weights.safetensors")


def test_curves_are_kept(trained: Trained) -> None:
    folder, _ = trained
    rows = load_rows(folder / "gnet/only/curve.parquet", LEARNING_CURVE)
    assert [row["step"] for row in rows] == [0, 1, 2] and all(row["seconds"] > 0 for row in rows)
    assert (folder / "gnet/only/curve.png").read_bytes().startswith(b"\x89PNG")


def test_validation_beside_tuned_adam(trained: Trained) -> None:
    rows = load_rows(trained[0] / "gnet/only/validation.parquet", VALIDATION_SCORES)
    assert [row["step"] for row in rows] == [2, 3] and all("seed=900" in row["scene"] for row in rows)
    assert rows[0]["start_db"] == rows[1]["start_db"] and rows[0]["learned_db"] != rows[1]["learned_db"]
    assert all(5 < row["start_db"] < row["adam_db"] < 60 and 5 < row["learned_db"] < 60 for row in rows)
    assert not (trained[0] / "enet/gnet/validation.parquet").exists()


def test_a_stopped_stage_resumes_to_the_same_bytes(trained: Trained, tmp_path: Path) -> None:
    folder = tmp_path / "again"
    shutil.copytree(trained[0], folder)
    shutil.rmtree(folder / "gnet")

    def stop(done: int, total: int, note: str = "") -> None:
        if "loss" in note and done == 2:
            raise KeyboardInterrupt

    job = TrainJob(str(folder), "tiny", save_every=1)
    with pytest.raises(KeyboardInterrupt):
        train_stage(job, TABLE[1], stop)
    with pytest.raises(InputError, match="gnet/only has made 1 of 3 weight updates"):
        train_stage(job, TABLE[2])
    again = train_stage(job, TABLE[1])
    assert not again.cached
    for name in ("weights.safetensors", "checkpoint.safetensors"):
        assert digest_file(folder / "gnet/only" / name) == digest_file(trained[0] / "gnet/only" / name)
    curves = [load_rows(where / "gnet/only/curve.parquet", LEARNING_CURVE) for where in (trained[0], folder)]
    assert [{**row, "seconds": 0} for row in curves[0]] == [{**row, "seconds": 0} for row in curves[1]]


@pytest.mark.parametrize("damage", ["deleted", "cut"])
@pytest.mark.parametrize("name", ["weights.safetensors", "weights.json"])
def test_lost_weights_come_from_the_checkpoint(trained: Trained, tmp_path: Path, name: str, damage: str) -> None:
    folder = tmp_path / "again"
    shutil.copytree(trained[0], folder)
    lost = folder / "gnet/only" / name
    content = lost.read_bytes()
    lost.unlink()
    if damage == "cut":
        lost.write_bytes(content[:-9])
    with pytest.raises(InputError, match=r"weights of the stage gnet/only are missing or damaged .*--stage gnet/only"):
        train_stage(TrainJob(str(folder), "tiny"), TABLE[2])
    again = train_network("gnet", str(folder), "tiny")
    assert again["stages"] == [("enet/3dgs", True), ("gnet/only", True)]
    for file in (folder / "gnet/only" / name, folder / f"gnet{Path(name).suffix}"):
        assert digest_file(file) == digest_file(trained[0] / "gnet/only" / name)


def test_scores_of_a_deleted_training_are_not_mixed_in(trained: Trained, tmp_path: Path) -> None:
    folder = tmp_path / "again"
    shutil.copytree(trained[0], folder)
    (folder / "gnet/only/checkpoint.safetensors").unlink()
    train_stage(TrainJob(str(folder), "tiny", save_every=3, validate_every=3), TABLE[1])
    rows = load_rows(folder / "gnet/only/validation.parquet", VALIDATION_SCORES)
    assert [row["step"] for row in rows] == [3]


def test_a_checkpoint_of_another_training_is_refused(trained: Trained, tmp_path: Path) -> None:
    folder = tmp_path / "other"
    shutil.copytree(trained[0], folder)
    job = TrainJob(str(folder), "tiny")
    with pytest.raises(InputError, match=r"made with other config .*empty folder"):
        train_stage(job, replace(TABLE[1], config=CONFIG))
    with pytest.raises(InputError, match="other start"):
        train_stage(job, replace(TABLE[1], initial_weights=None))
    with pytest.raises(InputError, match="other scenes and training scenes"):
        train_stage(job, replace(TABLE[1], starts=(Adam(2),)))
    with pytest.raises(InputError, match="a network with other hidden"):
        train_stage(job, replace(TABLE[1], network=NetworkConfig(hidden=9, channels=(4, 6))))
    (folder / "gnet/only/checkpoint.safetensors").write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match="checkpoint cannot be read"):
        train_stage(job, TABLE[1])


def test_a_stage_of_another_network_is_refused(trained: Trained) -> None:
    with pytest.raises(ConfigError, match=r"enet/gnet is no stage of gnet\. .*genre train enet"):
        train_network("gnet", str(trained[0]), "tiny", stage="enet/gnet")


def test_scenes_of_a_real_log_follow_its_files(monkeypatch: pytest.MonkeyPatch) -> None:
    digests = iter("abab")
    monkeypatch.setattr(training_scenes, "cached_log", lambda uri: SimpleNamespace(digest=lambda: next(digests)))
    real, street = SceneRecipe("pandaset:002"), SceneRecipe("synthetic:street?seed=5")
    assert real.key_fields() != real.key_fields() and real.image_key_fields() != real.image_key_fields()
    assert real.seed_fields() == real.seed_fields() and "log" not in street.key_fields()


def test_two_processes_do_not_train_one_stage(trained: Trained, tmp_path: Path) -> None:
    folder = tmp_path / "busy"
    shutil.copytree(trained[0], folder)
    job = TrainJob(str(folder), "tiny")
    with hold_training_folder(folder / "gnet/only"):
        with pytest.raises(InputError, match="another process trains in this folder"):
            train_stage(job, TABLE[1])
        # Another stage has a folder of its own.
        assert train_stage(job, TABLE[0]).cached
    assert train_stage(job, TABLE[1]).cached


def test_a_stage_alone_needs_those_before_it(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"enet/3dgs is not trained yet .*genre train enet --stage enet/3dgs"):
        train_network("gnet", str(tmp_path), "tiny", stage="gnet/only")
    with pytest.raises(ConfigError, match="no stage 'gnet/none'"):
        train_network("gnet", str(tmp_path), "tiny", stage="gnet/none")
    with pytest.raises(ConfigError, match="no recipe is called 'none'"):
        train_network("gnet", str(tmp_path), "none")


def test_other_seeds_and_chunks_do_not_train(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(
        scene_lists, "list_coarse_scenes", lambda *_: [SceneRecipe("synthetic:street?cameras=1&seed=900")]
    )
    with pytest.raises(ConfigError, match=r"seed 900 .* not for training. Use seeds 0 to 899"):
        train_scenes(str(tmp_path), "tiny")
    monkeypatch.setattr(scene_lists, "list_coarse_scenes", lambda *_: [SceneRecipe("pandaset:002", chunk=1)])
    with pytest.raises(ConfigError, match=r"chunk 1 .* not for training"):
        train_scenes(str(tmp_path), "tiny")


def test_rounds_move_the_begins_on() -> None:
    at = list_stage_scenes(TABLE[0], None)
    assert [scene.start for scene in at] == [AGES[0], AGES[1], AGES[1], AGES[2]]
    assert at[0].recipe == at[2].recipe


def test_a_planned_scene_has_its_effects_and_plain_ones_their_old_keys(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    forced = training_scenes.TRAINING_EFFECTS.model_copy(
        update={"rolling_shutter": "on", "exposure": "on"}
    )  # tiny images call for little
    monkeypatch.setattr(training_scenes, "TRAINING_EFFECTS", forced)
    uri = f"synthetic:street?seed=1{SMALL}&rolling_shutter_s=0.05&exposure_jitter=0.3"
    plain = SceneRecipe(uri, max_points=150, distant_count=20, width_px=32, height_px=18)
    planned = replace(plain, planned=True)
    assert "planned" not in plain.key_fields() and planned.key_fields() == {**plain.key_fields(), "planned": True}
    store = TrainJob(str(tmp_path)).store
    for recipe in (plain, planned, planned):  # the last from the store
        scene = build_training_scene(prepare_scene(store, recipe))
        targets = (*scene.source, *scene.heldout)
        assert {t.shutter is not None for t in targets} == {recipe.planned}
        assert {t.log_gain is not None for t in targets} == {recipe.planned}
        assert all(t.shutter is None for t in scene.truth)


def test_a_stage_may_tell_a_network_residuals_and_train_nothing(trained: Trained, tmp_path: Path) -> None:
    shutil.copytree(trained[0], tmp_path / "again")
    job = TrainJob(str(tmp_path / "again"), "tiny")
    network = NETWORK.model_copy(update={"residuals": True, "relaxation": -0.5, "rates": (0.1,) * 5})
    residual_stage = replace(TABLE[1], name="gnet/told", initial_weights="gnet/only", network=network, config=CONFIG)
    residual_stage = replace(residual_stage, config=residual_stage.config.model_copy(update={"steps": 0}))
    done = [train_stage(job, residual_stage) for _ in range(2)]
    assert [d.cached for d in done] == [False, True]
    before, after = (load_optimiser(job.stage_weights(f"gnet/{name}")) for name in ("only", "told"))
    assert after.config == network and torch.equal(before.mix.weight, after.mix.weight)


def test_scenes_of_several_sizes_share_their_images(tmp_path: Path) -> None:
    store, recipe = TrainJob(str(tmp_path)).store, tiny_scenes(1)[0]
    small, large = prepare_scene(store, recipe), prepare_scene(store, replace(recipe, max_points=300))
    assert len(small.initial.scene) < len(large.initial.scene)
    counts = {stage: len(list(tmp_path.glob(f"store/*/*/0000/{stage}/*"))) for stage in ("ingest", "truth", "initial")}
    assert counts == {"ingest": 1, "truth": 1, "initial": 2}


def test_an_unsound_scene_is_made_anew(trained: Trained, tmp_path: Path) -> None:
    shutil.copytree(trained[0] / "store", tmp_path / "store")
    job = TrainJob(str(tmp_path), "tiny")
    (recipe, *_) = tiny_scenes(2)
    file = next((tmp_path / "store").glob("synthetic/*seed=0*/0000/initial/*/gaussians.parquet"))
    before = file.read_bytes()
    file.write_bytes(before[:-9] + b"x" + before[-8:])
    stage_scenes.make_scene_artifacts(job, recipe, stage_scenes.list_scene_uses(TABLE, None)[recipe])
    assert file.read_bytes() == before


def test_a_repair_leaves_what_another_training_has_made_meanwhile(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    store = LocalStore(tmp_path)
    damaged = store.commit(address(), "evaluation", make("evaluation"))
    (damaged.path / "metrics.parquet").write_bytes(b"else")
    verify = LocalStore.verify

    def verify_slowly(opened: LocalStore, artifact: Artifact) -> None:
        try:
            verify(opened, artifact)
        except ArtifactCorruptError:
            monkeypatch.setattr(LocalStore, "verify", verify)
            store.commit(address(), "evaluation", make("evaluation", 1))
            raise

    def refuse() -> None:
        raise AssertionError("nothing is left to make")

    monkeypatch.setattr(LocalStore, "verify", verify_slowly)
    found = training_scenes.get_or_make(store, address(), "evaluation", refuse)
    assert_same(make("evaluation", 1), found, "evaluation")
    # What nobody has repaired is made again.
    (damaged.path / "metrics.parquet").write_bytes(b"else")
    again = training_scenes.get_or_make(store, address(), "evaluation", lambda: make("evaluation", 2))
    assert_same(make("evaluation", 2), again, "evaluation")
