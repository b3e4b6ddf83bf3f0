"""``genre perceive``: a detector on a finished run's recorded and rendered images; its table, picture and numbers."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from typer.testing import CliRunner

from flows.cli.main import app
from flows.configuration import load_configuration
from flows.perception.perceive import PerceiveRequest, perceive_run, tabulate_perception
from flows.perception.perceived_images import perceive_views, select_views
from flows.pipeline.definition import STAGE_BY_NAME
from flows.pipeline.stage_runner import ArtifactRef, Job, run_stage
from flows.reconstruction.run_records import FinishedRun, summarise_run, write_run_record
from flows.simulation.edited_runs import write_edited_run
from flows.simulation.run_scenes import RunScenes
from genre_tasks.detection import detector as detector_module
from genre_tasks.detection.coco_classes import COCO_CLASSES
from genre_tasks.detection.detections import Detections
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.scene_edits.edits import EditList

REAL = Path("../shared/data/detectors")
WIDTH, HEIGHT = 64, 36
LOG = f"synthetic:street?seed=900&frames=8&cameras=2&width={WIDTH}&height={HEIGHT}&lidar_beams=32&lidar_azimuths=300"
SETTINGS = [
    *(f"ingest.width_px={WIDTH}", f"ingest.height_px={HEIGHT}", "initial.max_points=600"),
    "initial.distant_count=100",
]
CAR, CHAIR = 2, 56


class CornerDetector:
    """Finds a car whose box grows with the image's mean brightness, and a chair; with masks or without."""

    class_names = COCO_CLASSES

    def __init__(self, has_masks: bool = True) -> None:
        self.has_masks = has_masks

    def detect(self, image: np.ndarray) -> Detections:
        assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.uint8
        side = 10 + float(image.mean()) / 255 * 10
        boxes = np.array([[2, 3, 2 + side, 3 + side], [0, 0, 5, 5]], np.float32)
        masks = np.zeros((2, HEIGHT, WIDTH), bool)
        masks[0, 3 : 3 + int(side), 2 : 2 + int(side)] = True
        scores = np.array([0.9, 0.4], np.float32)
        return Detections(boxes, scores, np.array([CAR, CHAIR]), masks if self.has_masks else None)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    """A run that ended with the initial scene."""
    store = str(tmp_path_factory.mktemp("store"))
    config = load_configuration("demo", settings=SETTINGS).model_dump(mode="json")
    job = Job(LOG, 0, store, config)
    refs: dict[str, ArtifactRef] = {}
    for name in ("ingest", "effects", "initial"):
        refs[name] = run_stage(name, job, {stage: refs[stage] for stage in STAGE_BY_NAME[name].inputs})
    run = FinishedRun(LOG, "demo", store, config, {}, {0: refs})
    write_run_record(run, summarise_run(run), {})
    return run


def request(finished: FinishedRun, out: Path, **more: object) -> PerceiveRequest:
    return PerceiveRequest(finished.store, finished.name, out, **more)  # type: ignore[arg-type]


def test_every_view_is_looked_at_recorded_and_rendered_at_each_shift(finished: FinishedRun, tmp_path: Path) -> None:
    wanted = request(finished, tmp_path / "new", shifts_m=(0.0, 2.0, -2.0), every=4)
    perception = perceive_run(wanted, CornerDetector())
    assert [(c.source, c.shift_m, c.images, c.finds) for c in perception.counts] == [
        ("recorded", 0.0, 4, 4),  # two cameras at two frames; chairs are no road users
        *(("rendered", shift, 4, 4) for shift in (0.0, 2.0, -2.0)),
    ]
    assert perception.boxes is not None and perception.masks is not None
    assert perception.boxes.instances == perception.masks.instances == 4 and perception.boxes.recall == 1
    assert 0.5 < perception.boxes.matched_overlap < 1  # a render is not as bright as its image
    table = pq.read_table(tmp_path / "new/detections.parquet")
    rows = table.to_pylist()
    assert len(rows) == 4 * 4 * 2 and table.schema.metadata[b"stage"] == b"initial"
    assert {row["class"] for row in rows} == {"car", "chair"} and {row["source"] for row in rows[:4]} == {"recorded"}
    mask = np.asarray(Image.open(io.BytesIO(rows[0]["mask"])))
    assert mask.shape == (HEIGHT, WIDTH) and mask[3, 2] and not mask[2, 2] and rows[0]["x0_px"] == 2
    with Image.open(tmp_path / "new/perception.png") as picture:
        assert picture.width == 2 * WIDTH and picture.height > 4 * HEIGHT


def test_the_numbers_are_those_of_the_views_compared_one_by_one(finished: FinishedRun, tmp_path: Path) -> None:
    part = RunScenes(finished.store, finished.name).load(0)
    views = select_views(part.chunk, ("front_camera",), 1)
    perceived = list(perceive_views(part.chunk, part.scene, views, (0.0,), CornerDetector()))
    by_kind = {
        kind: [p.detections.boxes[0] for p in perceived if p.source == kind] for kind in ("recorded", "rendered")
    }
    sides = [[float(box[2] - box[0]) for box in by_kind[kind]] for kind in ("recorded", "rendered")]
    overlaps = [min(a, b) ** 2 / max(a, b) ** 2 for a, b in zip(*sides, strict=True)]  # squares of one corner
    found = perceive_run(request(finished, tmp_path, cameras=("front_camera",)), CornerDetector(has_masks=False))
    assert found.boxes is not None and found.boxes.instances == len(views) == 8 and found.masks is None
    assert found.boxes.mean_overlap == pytest.approx(np.mean(overlaps), abs=1e-5)
    first, second = tabulate_perception(found)
    assert (
        (first["source"], second["shift"]) == ("recorded", "+0 m")
        and first["box AP"] == ""
        and second["box AP"] == "1.00"
    )
    assert pq.read_table(tmp_path / "detections.parquet")["mask"].null_count == 8 * 2 * 2


def test_next_to_the_path_nothing_is_compared(finished: FinishedRun, tmp_path: Path) -> None:
    found = perceive_run(request(finished, tmp_path, shifts_m=(3.0,), every=8), CornerDetector())
    assert found.boxes is None and found.masks is None and [c.shift_m for c in found.counts] == [0.0, 3.0]
    assert all(row["box AP"] == "" for row in tabulate_perception(found))


def test_a_run_with_edited_traffic_has_counts_and_no_agreement(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    edited = write_edited_run(finished.store, finished.name, EditList())["run"]
    wanted = PerceiveRequest(finished.store, edited, tmp_path / "on", shifts_m=(0.0, 2.0), every=4)
    found = perceive_run(wanted, CornerDetector())
    assert found.boxes is None and found.masks is None
    assert [(c.source, c.shift_m, c.finds) for c in found.counts] == [
        *(("recorded", 0.0, 4), ("rendered", 0.0, 4), ("rendered", 2.0, 4))
    ]
    assert f"that of the run {finished.name}" in found.no_agreement
    next_to_the_path = perceive_run(replace(wanted, shifts_m=(2.0,)), CornerDetector())
    assert next_to_the_path.no_agreement == ""
    monkeypatch.setattr(detector_module, "open_detector", lambda *_: CornerDetector())
    words = ["--store", finished.store, "--out", str(tmp_path / "out"), "--every", "4", "--detector", "x.onnx"]
    done = CliRunner().invoke(app, ["perceive", edited, *words], catch_exceptions=False)
    assert done.exit_code == 0 and "no agreement: its traffic is edited" in done.output
    done = CliRunner().invoke(app, ["perceive", finished.name, *words], catch_exceptions=False)
    assert done.exit_code == 0 and "no agreement" not in done.output


def test_the_command_prints_a_row_for_each_shift(
    finished: FinishedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[tuple[object, ...]] = []

    def opened(*arguments: object) -> CornerDetector:
        asked.append(arguments)
        return CornerDetector()

    monkeypatch.setattr(detector_module, "open_detector", opened)
    words = ["perceive", finished.name, "--store", finished.store, "--out", str(tmp_path), "--every", "4"]
    words += ["--detector", "x.onnx", "--shift", "0,1.5", "--min-score", "0.2"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert asked == [("x.onnx", None, 0.2)]
    assert "recorded" in done.output and "+1.5 m" in done.output and "box AP" in done.output
    assert "counted: person, bicycle, car" in done.output and (tmp_path / "perception.png").is_file()
    with pytest.raises(InputError, match=r"no camera 'roof'.*front"):
        CliRunner().invoke(app, [*words, "--cameras", "front_camera,roof"], catch_exceptions=False)
    for option, value in (("--min-score", "2"), ("--every", "0"), ("--shift", "left")):
        with pytest.raises(ConfigError, match=option):
            CliRunner().invoke(app, [*words, option, value], catch_exceptions=False)


@pytest.mark.skipif(not (REAL / "FastestDet.onnx").is_file(), reason="the detector is not there")
def test_a_real_detector_looks_at_a_run(finished: FinishedRun, tmp_path: Path) -> None:
    words = ["perceive", finished.name, "--store", finished.store, "--out", str(tmp_path), "--every", "8"]
    words += ["--detector", str(REAL / "FastestDet.onnx"), "--shift", "0", "--min-score", "0.05"]
    done = CliRunner().invoke(app, words, catch_exceptions=False)
    assert done.exit_code == 0 and "+0 m" in done.output, done.output
    rows = pq.read_table(tmp_path / "detections.parquet").to_pylist()
    assert rows and all(0 <= row["x0_px"] < row["x1_px"] <= WIDTH and row["score"] >= 0.05 for row in rows)
