"""``genre table 2 --scene``: a scene of another program before and after enhancement, on the paper's page."""

from __future__ import annotations

import json
import re
import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from flows.enhancement.enhancement_request import EnhancementInputs
from flows.experiments.stage_prediction import StagePredictor
from flows.paper_tables.layouts import SCENE_LAYOUTS
from flows.paper_tables.measure import warm_up
from flows.paper_tables.published_numbers import PAPER
from flows.paper_tables.request import TableRequest
from flows.pipeline.stage_runner import ArtifactRef, Job
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError, GenreError, InputError
from tests.faults.small_run import LOG, SETTINGS
from tests.flows.street_scene_files import make_resting_street, write_street

pytest.importorskip("embreex", reason="the synthetic street is ray-cast with Embree")

TINY = tuple(s for s in SETTINGS if not s.startswith("gnet."))
LABELS = ["Scene as given", "Scene + GenRe", "Scene + Difix3D-style"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("street")
    write_street(folder)
    return folder


def make_request(folder: Path, store: Path) -> TableRequest:
    scene = EnhancementInputs(folder / "scene.ply", folder, scale="2.5")
    return TableRequest(2, (), "demo", str(store), settings=TINY, scene=scene)


def test_a_scene_is_compared_before_and_after(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from prefect.testing.utilities import prefect_test_harness

    monkeypatch.setattr("flows.paper_tables.flow.warm_up", lambda basis, layout: None)
    monkeypatch.setenv("PREFECT_HOME", str(tmp_path / "prefect"))
    words = ["table", "2", "--scene", str(folder / "scene.ply"), "--cameras", str(folder), "--scale", "2.5"]
    words += ["--preset", "demo", *(word for setting in TINY for word in ("--set", setting))]
    places = ["--store", str(tmp_path / "store"), "--out", str(tmp_path / "out")]
    with prefect_test_harness(server_startup_timeout=120):
        done = CliRunner().invoke(app, [*words, *places], catch_exceptions=False)
    assert "3 cells, 0 left out" in done.stdout and "a unit is 2.5 m" in done.stderr

    table = pq.read_table(tmp_path / "out/table2_posed_images.parquet").to_pydict()
    assert table["method"] == LABELS
    metrics = [json.loads(text) for text in table["metrics"]]
    # The scene as given went into every row, and both enhancements changed it, each in its way.
    _, scene = make_resting_street()
    assert table["gaussians"][0] == len(scene)
    for name in ("interpolation/psnr", "shift_3m/kernel"):
        assert len({m[name] for m in metrics}) == 3, name
    assert metrics[1]["interpolation/psnr"] > metrics[0]["interpolation/psnr"]
    # The paper's pair is beside the scene without and with GenRe.
    paper = [json.loads(text)["fid_3m"] if text != "{}" else None for text in table["paper"]]
    assert paper == [154.21, 99.69, None]

    page = (tmp_path / "out/table2_posed_images.md").read_text()
    assert "a unit is 2.5 m" in page and "scene may have been made from them" in page
    command = re.findall(r"\* command: `(.*)`", page)[0]
    again = CliRunner().invoke(app, [*shlex.split(command)[1:], *places, "--dry-run"], catch_exceptions=False)
    assert "3 cells, 0 minutes" in again.stdout and again.stdout.count("8 of 8 stages") == 2, again.stdout


def test_the_scene_goes_before_the_users_settings_and_methods(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "own.yaml"
    file.write_text("name: longer\nsettings: [enet.iterations=9]\n")
    request = TableRequest(
        2,
        (),
        "demo",
        str(tmp_path / "store"),
        settings=("ingest.width_px=32", "ingest.height_px=20", "gnet.method=learned"),
        methods=(str(file),),
        scene=EnhancementInputs(folder / "scene.ply", folder, lidar=folder / "points.ply", scale="2.5"),
    )
    checked = request.check()
    assert checked.dataset == "posed_images" and not checked.missing
    configs = [PipelineConfig.model_validate(job.config) for job, _ in checked.list_jobs()]
    assert {c.ingest.width_px for c in configs} == {32}
    assert {(c.initial.scene, c.ingest.points) for c in configs} == {
        (str(folder / "scene.ply"), str(folder / "points.ply"))
    }
    # The table's own rows start from the scene, whatever the user sets for all.
    assert [c.gnet.method for c in configs] == ["none", "none", "none", "learned"]
    assert [c.enet.method for c in configs] == ["learned", "learned", "adam", "learned"]
    assert configs[-1].enet.iterations == 9
    assert "--lidar" in request.command and "--scale 2.5" in request.command


def test_passing_a_scene_on_is_predicted_to_cost_nothing(folder: Path, tmp_path: Path) -> None:
    job, stages = make_request(folder, tmp_path / "store").check().list_jobs()[0]
    config = PipelineConfig.model_validate(job.config)
    predicted = [
        StagePredictor(job.store).predict("scene", job, config, names)["seconds"]
        for names in (stages, [name for name in stages if name != "gnet"])
    ]
    assert predicted[0] == predicted[1] > 0


def test_the_warm_up_is_without_the_scene(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    warmed: list[PipelineConfig] = []

    def keep(names: Sequence[str], job: Job, runner: object) -> dict[str, ArtifactRef]:
        warmed.append(PipelineConfig.model_validate(job.config))
        return {}

    monkeypatch.setattr("flows.experiments.warm_up.run_stages", keep)
    monkeypatch.setattr("flows.experiments.warm_up.read_stage_costs", lambda job, refs: SimpleNamespace(seconds={}))
    checked = make_request(folder, tmp_path / "store").check()
    basis = replace(checked.basis, settings=(*checked.basis.settings, "ingest.cameras=[CAM_FRONT]"))
    warm_up(basis, checked.layout)
    assert warmed[0].ingest.cameras is None and warmed[0].ingest.placement == warmed[0].initial.placement
    preset = load_configuration("demo")
    # The tiny log's street is not where the scene is.
    assert warmed[0].initial.scene is None and warmed[0].initial.placement == preset.initial.placement
    assert warmed[0].ingest.scene is None and warmed[0].enet.iterations == 2


def test_every_number_of_the_paper_has_its_place() -> None:
    for number, layout in SCENE_LAYOUTS.items():
        assert {row.paper for row in layout.rows} - {""} <= set(PAPER[number].rows)
        assert [row.label for row in layout.rows] == LABELS


def test_what_does_not_go_together_is_an_error(folder: Path, tmp_path: Path) -> None:
    scene = ["--scene", str(folder / "scene.ply")]
    cameras = ["--cameras", str(folder)]
    wrong: list[tuple[list[str], type[GenreError], str]] = [
        (["4", *scene, *cameras, "--scale", "1"], ConfigError, "table 4 .* takes no scene.*genre table 2 --scene"),
        (["9", *scene, *cameras, "--scale", "1"], ConfigError, "there is no table 9"),
        (["2", LOG, *scene, *cameras, "--scale", "1"], ConfigError, "both a scene and a log"),
        (["2"], ConfigError, "nothing to measure"),
        (["2", *scene, "--scale", "1"], ConfigError, "where the cameras of .*scene.ply are.*--cameras"),
        (["2", *scene, *cameras], ConfigError, "how long a metre is"),
        (["2", "--scene", str(tmp_path / "none.ply"), *cameras, "--scale", "1"], InputError, "no such file"),
        (["2", *scene, "--cameras", str(tmp_path), "--scale", "1"], InputError, "transforms.json"),
    ]
    for option, value in (
        ("--cameras", str(folder)),
        ("--images", str(folder)),
        ("--lidar", "points.ply"),
        ("--up", "0,0,1"),
        ("--scale", "1"),
        ("--chunk-frames", "4"),
    ):
        wrong.append((["2", LOG, option, value], ConfigError, f"{option} belongs to a scene"))
    for words, kind, said in wrong:
        done = CliRunner().invoke(app, ["table", *words, "--store", str(tmp_path / "store"), "--dry-run"])
        assert isinstance(done.exception, kind), (words, done.exception)
        assert re.search(f"(?s){said}", str(done.exception)), (words, str(done.exception))
