"""``genre enhance``: a file of Gaussians in its own axes goes through all stages, and lands where it belongs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from flows.cli import enhance as cli_enhance
from flows.cli.main import app
from flows.cli.run import RunRequest
from flows.configuration import load_configuration
from flows.enhancement.enhancement_request import EnhancementInputs, prepare_enhancement
from flows.pipeline.definition import PIPELINE, STAGE_BY_NAME
from flows.pipeline.stage_runner import ArtifactRef, Job, compute_key, read_artifact, run_stage
from flows.reconstruction.enhancement_check import MOST_LOSS_DB
from genre_tasks.config import FilePlacement, InitialConfig, PipelineConfig
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply import PLY
from genre_tasks.exchange.registry import load_format
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Lens
from genre_tasks.render import render_views
from genre_tasks.scene.chunk import NO_SWEEP, Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import NovelView
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.stages.ingest import ingest
from genre_tasks.stages.initial import initial
from genre_tasks.stages.scene_file import read_placed_scene
from tests.exchange.splat_clouds import make_driving_scene
from tests.faults.small_run import LOG, SETTINGS
from tests.flows.street_scene_files import SIZE, in_source_axes, make_resting_street, write_street

pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")

# Distances between sets of images take most of a run's time, and say nothing of the scene's place.
TINY = (*(setting for setting in SETTINGS if not setting.startswith("gnet.")), "evaluate.distributions=false")


@pytest.fixture(scope="module")
def street() -> tuple[Chunk, SceneGraph]:
    return make_resting_street()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    write_street(folder)
    return folder


@pytest.fixture
def inputs(folder: Path) -> EnhancementInputs:
    return EnhancementInputs(scene=folder / "scene.ply", cameras=folder, scale="2.5")


def test_a_scene_goes_through_every_stage_and_the_command_finds_it(
    inputs: EnhancementInputs, folder: Path, street: tuple[Chunk, SceneGraph], tmp_path: Path
) -> None:
    prepared = prepare_enhancement(inputs, load_configuration("demo"))
    config = load_configuration("demo", settings=[*prepared.settings, *TINY])
    job = Job(prepared.log, 0, str(tmp_path), config.model_dump(mode="json"))
    refs: dict[str, ArtifactRef] = {}
    for spec in PIPELINE:
        refs[spec.name] = run_stage(spec.name, job, refs)
    chunk: Chunk = read_artifact(job, refs["ingest"])
    assert [issue.kind for issue in chunk.log_issues if issue.kind == "depth_of_scene"] == ["depth_of_scene"]
    # Points and Gaussians of the file lie where the street has them, but for the heading of the world.
    true_chunk, scene = street
    given = read_artifact(job, refs["gnet"]).scene
    heights = given.gaussians.means[:, 2] + chunk.world_SE3_chunk[2, 3]
    true_heights = scene.gaussians.means[:, 2] + true_chunk.world_SE3_chunk[2, 3]
    torch.testing.assert_close(heights, true_heights.to(heights), atol=1e-3, rtol=0)
    torch.testing.assert_close(given.gaussians.log_scales, scene.gaussians.log_scales, atol=1e-4, rtol=0)
    view = chunk.views[0]
    with torch.no_grad():
        ours = render_views(given, [view]).color
        theirs = render_views(scene, [true_chunk.views[0]]).color
    assert float((ours - theirs).abs().mean()) < 2e-3
    assert len(read_artifact(job, refs["enet"]).scene) > len(given)

    words = ["enhance", str(folder / "scene.ply"), "--cameras", str(folder), "--scale", "2.5", "--preset", "demo"]
    words += [word for setting in TINY for word in ("--set", setting)]
    done = CliRunner().invoke(app, [*words, "--store", str(tmp_path), "--json"], catch_exceptions=False)
    record = json.loads(done.stdout)
    assert record["status"] == "done" and record["log"] == prepared.log
    assert {s["stage"]: s["cached"] for s in record["chunks"][0]["stages"]} == {spec.name: True for spec in PIPELINE}
    warnings = record["chunks"][0]["warnings"]
    assert any("depth of scene" in warning for warning in warnings)
    psnr = {s["stage"]: s["metrics"].get("interpolation/psnr") for s in record["chunks"][0]["stages"]}
    is_worse = psnr["gnet"] - psnr["enet"] > MOST_LOSS_DB
    assert any("ENet made the scene worse" in warning for warning in warnings) == is_worse
    assert "a unit is 2.5 m" in done.stderr


def test_points_of_lidar_are_placed_as_the_scene_is(inputs: EnhancementInputs, folder: Path, street: tuple) -> None:
    inputs = replace(inputs, lidar=folder / "points.ply")
    prepared = prepare_enhancement(inputs, load_configuration("demo"))
    config = load_configuration("demo", settings=[*prepared.settings, *SIZE])
    chunk = ingest(config.ingest, open_log(prepared.log), 0)
    true_chunk, _ = street
    heights = chunk.static.positions[:, 2] + chunk.world_SE3_chunk[2, 3]
    true_heights = true_chunk.static.positions[:, 2] + true_chunk.world_SE3_chunk[2, 3]
    np.testing.assert_allclose(heights, true_heights, atol=1e-3)
    # Colours come from the same pixels, but where the street has actors that hide points.
    assert np.mean(chunk.static.colors == true_chunk.static.colors) > 0.8


def test_the_depth_of_the_scene_lies_on_the_street(inputs: EnhancementInputs, street: tuple) -> None:
    from scipy.spatial import cKDTree

    prepared = prepare_enhancement(inputs, load_configuration("demo"))
    config = load_configuration("demo", settings=[*prepared.settings, *SIZE])
    log = open_log(prepared.log)
    chunk = ingest(config.ingest, log, 0)
    true_chunk, _ = street
    # From chunk to chunk by way of the camera that both have.
    true_SE3_chunk = true_chunk.views[0].chunk_SE3_camera @ invert_se3(chunk.views[0].chunk_SE3_camera)
    points = chunk.static.positions @ true_SE3_chunk[:3, :3].T + true_SE3_chunk[:3, 3]
    distance = cKDTree(true_chunk.static.positions).query(points)[0]
    # Few and large Gaussians at 64 pixels: within what counts as agreement of two views.
    depth = np.linalg.norm(points - true_chunk.views[0].chunk_SE3_camera[:3, 3], axis=1)
    assert np.median(distance / depth) < 0.05
    # Held-out views show surfaces too, and the road that no view shows is of no frame.
    assert set(np.unique(chunk.static.frames)) == {NO_SWEEP, *(view.frame for view in chunk.views)}


def test_the_scale_is_found_from_the_height_over_the_ground(inputs: EnhancementInputs, folder: Path) -> None:
    preset = load_configuration("demo")
    for lidar in (None, folder / "points.ply"):
        prepared = prepare_enhancement(replace(inputs, scale="auto", lidar=lidar), preset)
        scale = float(prepared.log.rpartition("scale=")[2])
        log = open_log(LOG)
        true_height = log.world_SE3_camera("front_camera", 0)[2, 3] - log.world_SE3_lidar(0)[2, 3]
        # The street's cameras are at another height than the one that is assumed.
        assert 0.7 < scale / 2.5 < 1.3, true_height


def test_a_scale_has_to_come_from_somewhere(inputs: EnhancementInputs) -> None:
    with pytest.raises(ConfigError, match="how long a metre is"):
        prepare_enhancement(replace(inputs, scale=None), PipelineConfig())


@pytest.mark.parametrize("suffix", [".spz", ".glb", ".usda"])
def test_a_format_with_axes_of_its_own_is_refused(inputs: EnhancementInputs, tmp_path: Path, suffix: str) -> None:
    scene = tmp_path / f"scene{suffix}"
    scene.write_bytes(b"")
    with pytest.raises(InputError, match=r"has axes of its own.*leaves axes and units as they are; `genre import`"):
        prepare_enhancement(replace(inputs, scene=scene), PipelineConfig())


def test_errors_of_the_command(folder: Path, tmp_path: Path) -> None:
    scene = str(folder / "scene.ply")
    runner = CliRunner()
    for reason, words in {
        "how long a metre is": [scene, "--cameras", str(folder)],
        "no camera poses": [scene, "--cameras", str(tmp_path), "--scale", "1"],
        "no such file": [str(tmp_path / "none.ply"), "--cameras", str(folder), "--scale", "1"],
        "none of the 8 images": [scene, "--cameras", str(folder), "--images", str(tmp_path), "--scale", "1"],
        "'0' is no scale": [scene, "--cameras", str(folder), "--scale", "0"],
        "'up' is no direction": [scene, "--cameras", str(folder), "--up", "up", "--scale", "1"],
    }.items():
        done = runner.invoke(app, ["enhance", *words, "--store", str(tmp_path / "store")])
        assert isinstance(done.exception, InputError | ConfigError), words
        assert reason in done.exception.problem, words


def test_a_scene_elsewhere_is_an_error(inputs: EnhancementInputs) -> None:
    prepared = prepare_enhancement(replace(inputs, up="0,0,1"), load_configuration("demo"))
    config = load_configuration("demo", settings=[*prepared.settings, *SIZE, "ingest.placement={scale: 1000.0}"])
    with pytest.raises(InputError, match="next to nothing of the scene"):
        ingest(config.ingest, open_log(prepared.log), 0)


def test_keys_depend_on_the_file_and_not_on_its_place(inputs: EnhancementInputs, folder: Path, tmp_path: Path) -> None:
    prepared = prepare_enhancement(inputs, PipelineConfig())

    def key(scene: Path) -> str:
        settings = [*prepared.settings, f"ingest.scene={scene}"]
        config = load_configuration("demo", settings=settings).model_dump(mode="json")
        return compute_key(STAGE_BY_NAME["ingest"], Job(prepared.log, 0, str(tmp_path), config), {})[0]

    copy = tmp_path / "copy.ply"
    copy.write_bytes((folder / "scene.ply").read_bytes())
    assert key(copy) == key(folder / "scene.ply")
    copy.write_bytes(copy.read_bytes()[:-4] + b"\0\0\0\0")
    assert key(copy) != key(folder / "scene.ply")


def test_dense_scenes_are_not_split(inputs: EnhancementInputs) -> None:
    dense = prepare_enhancement(
        inputs, load_configuration("small", settings=["initial.max_points=100", "initial.distant_count=0"])
    )
    assert "enet.split_fraction=0" in dense.settings
    sparse = prepare_enhancement(inputs, load_configuration("small"))
    assert not any(setting.startswith("enet.") for setting in sparse.settings)


@pytest.mark.parametrize("lidar", [False, True])
def test_poses_and_colours_stay_those_of_the_scene(inputs: EnhancementInputs, folder: Path, lidar: bool) -> None:
    inputs = replace(inputs, lidar=folder / "points.ply" if lidar else None)
    prepared = prepare_enhancement(inputs, load_configuration("demo"))
    kept = ("pose_refinement", "anti_aliasing", "view_dependent_colour")
    effects = load_configuration("demo", settings=prepared.settings).effects
    assert [getattr(effects, name) for name in kept] == ["off"] * 3
    assert effects.exposure == "auto"
    assert any("effects.pose_refinement=on" in line for line in prepared.explanation)


def test_who_wants_poses_refined_sets_it(inputs: EnhancementInputs, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[RunRequest] = []
    monkeypatch.setattr(cli_enhance, "check_request", lambda request: None)
    monkeypatch.setattr(cli_enhance, "reconstruct", lambda request, as_json: asked.append(request))
    words = ["enhance", str(inputs.scene), "--cameras", str(inputs.cameras), "--scale", "2.5"]
    for more in ([], ["--set", "effects.pose_refinement=on"]):
        CliRunner().invoke(app, [*words, *more], catch_exceptions=False)
    assert [request.config.effects.pose_refinement for request in asked] == ["off", "on"]


def test_effects_that_a_scene_cannot_have_are_refused(inputs: EnhancementInputs, tmp_path: Path) -> None:
    words = ["enhance", str(inputs.scene), "--cameras", str(inputs.cameras), "--scale", "2.5", "--preset", "demo"]
    for setting, reason in {
        "effects.anti_aliasing=on": "anti_aliasing is set on, and initial.scene leaves it out",
        "effects.view_dependent_colour=on": "view_dependent_colour is set on, and gnet.method=none leaves it out",
    }.items():
        done = CliRunner().invoke(app, [*words, "--store", str(tmp_path), "--set", setting, "--dry-run"])
        assert isinstance(done.exception, ConfigError) and reason in done.exception.problem


# --- the file


@pytest.fixture
def colourful() -> Iterator[SplatCloud]:
    generator = np.random.default_rng(0)
    count = 200

    def draw(*shape: int) -> np.ndarray:
        return generator.standard_normal((count, *shape)).astype(np.float32)

    yield SplatCloud(draw(3), draw(3) * 0.2 - 1.5, draw(4), draw(), draw(3), 0.3 * draw(15, 3), antialiased=True)


def test_a_turned_scene_looks_the_same_from_the_turned_camera(colourful: SplatCloud, tmp_path: Path) -> None:
    PLY.write(tmp_path / "scene.ply", make_resting_scene(in_source_axes(colourful)))
    quat = (0.5**0.5, -(0.5**0.5), 0.0, 0.0)
    placement = FilePlacement(scale=2.5, quat=quat)
    origin = np.eye(4)
    origin[:3, 3] = (3.0, -2.0, 1.0)
    scene = read_placed_scene(str(tmp_path / "scene.ply"), placement, origin)
    assert scene.antialiased and scene.spherical_harmonics is not None
    PLY.write(tmp_path / "plain.ply", make_resting_scene(colourful))
    plain = read_placed_scene(str(tmp_path / "plain.ply"), FilePlacement(), np.eye(4))
    lens = Lens(40.0, 40.0, 24.0, 24.0, 48, 48)
    pose = np.eye(4)
    pose[:3, 3] = (0.0, 0.0, -6.0)
    moved = invert_se3(origin) @ pose
    ours, theirs = (
        render_views(s, [NovelView("c", 0, 0.0, p, lens, ("c", 0))]).color for s, p in ((scene, moved), (plain, pose))
    )
    assert float((ours - theirs).abs().max()) < 2e-3
    assert float(theirs.std()) > 0.05


def test_files_without_gaussians_are_refused(tmp_path: Path) -> None:
    PLY.write(tmp_path / "empty.ply", make_resting_scene(SplatCloud.empty()))
    with pytest.raises(InputError):
        read_placed_scene(str(tmp_path / "empty.ply"), FilePlacement(), np.eye(4))
    with pytest.raises(InputError, match="no such file"):
        read_placed_scene(str(tmp_path / "none.ply"), FilePlacement(), np.eye(4))


def test_files_with_moving_objects_are_refused(tmp_path: Path) -> None:
    load_format("glb").write(tmp_path / "scene.glb", make_driving_scene())
    with pytest.raises(InputError, match="moving parts"):
        read_placed_scene(str(tmp_path / "scene.glb"), FilePlacement(), np.eye(4))


def test_far_and_large_gaussians_are_distant(colourful: SplatCloud, tmp_path: Path, street: tuple) -> None:
    means = colourful.means.copy()
    means[0] = (500.0, 0.0, 0.0)
    log_scales = np.minimum(colourful.log_scales, 0.0)
    log_scales[1] = 2.0
    PLY.write(tmp_path / "scene.ply", make_resting_scene(replace(colourful, means=means, log_scales=log_scales)))
    chunk = replace(street[0], world_SE3_chunk=np.eye(4), chunk_SE3_ego=np.eye(4)[None])
    scene = initial(InitialConfig(scene=str(tmp_path / "scene.ply")), chunk).scene
    assert torch.nonzero(scene.nodes)[:, 0].tolist() == [0, 1]


def test_log_and_files_of_an_enhanced_scene_are_found_from_other_folders(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[RunRequest] = []
    monkeypatch.setattr(cli_enhance, "check_request", lambda request: None)
    monkeypatch.setattr(cli_enhance, "reconstruct", lambda request, as_json: asked.append(request))
    monkeypatch.chdir(folder.parent)
    words = ["enhance", f"{folder.name}/scene.ply", "--cameras", folder.name, "--scale", "2.5"]
    words += ["--set", f"ingest={{points: {folder.name}/scene.ply}}"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert len(asked) == 1 and asked[0].log.startswith(f"posed_images:{folder}")
    assert asked[0].config.ingest.points == str(folder / "scene.ply")
