"""Tables 7 and 8: a detector's agreement across cameras, and detectors trained with renders."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

import flows.paper_tables.agreement_cells as agreement_cells
from flows.cli.main import app
from flows.paper_tables.agreement_figure import agreement_strips
from flows.paper_tables.columns import MeasuredCell
from flows.paper_tables.detector_flow import DetectorRequest, render_page
from flows.paper_tables.detector_study import ROWS
from flows.paper_tables.flow import write_results
from flows.paper_tables.request import TableRequest
from flows.perception.camera_transfer import DetectionPairs, agreement_metrics, choose_image_size, list_camera_views
from flows.pipeline.log_cache import cached_log
from flows.pipeline.stage_runner import run_stage
from genre_tasks.detection.detections import Detections
from genre_tasks.detection3d.detector import load_detector
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Camera, Lens
from tests.faults.small_run import SETTINGS

LOG = "synthetic:street?seed=900&frames=8&cameras=2&width=64&height=36&lidar_beams=32&lidar_azimuths=300"
OTHER = LOG.replace("900", "901")


class QuadrantDetector:
    """Finds a car in each quadrant of an image that is brighter than the whole, with a mask of its bright pixels."""

    class_names = ("tree", "car")
    has_masks = True

    def detect(self, image: NDArray[np.uint8]) -> Detections:
        height, width = image.shape[:2]
        values = image.mean(2)
        boxes = []
        masks = []
        for top in (0, height // 2):
            for left in (0, width // 2):
                part = values[top : top + height // 2, left : left + width // 2]
                if part.mean() > values.mean():
                    boxes.append((left, top, left + width // 2, top + height // 2))
                    mask = np.zeros((height, width), bool)
                    mask[top : top + height // 2, left : left + width // 2] = part > values.mean()
                    masks.append(mask)
        count = len(boxes)
        return Detections(
            np.array(boxes, np.float32).reshape(-1, 4),
            np.linspace(0.9, 0.5, count, dtype=np.float32),
            np.ones(count, np.int64),
            np.array(masks, bool).reshape(-1, height, width),
        )


@pytest.fixture
def detector(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> str:
    monkeypatch.setattr("genre_tasks.detection.detector.open_detector", lambda name: QuadrantDetector())
    agreement_cells.open_cached_detector.cache_clear()
    yield str(tmp_path / "quadrants.onnx")
    agreement_cells.open_cached_detector.cache_clear()


def make_request(store: Path, detector: str | None, **values: object) -> TableRequest:
    return TableRequest(
        7, (LOG,), preset="demo", store=str(store), chunks=(0,), settings=SETTINGS, detector=detector, **values
    )


def test_a_cell_compares_the_camera_that_its_scene_was_made_without(tmp_path: Path, detector: str) -> None:
    request = make_request(tmp_path / "store", detector, out=str(tmp_path / "tables"))
    checked = request.check()
    assert checked.layout.protocol[-1] == "ingest.cameras=[front_camera]"
    row = next(row for row in checked.measurable_rows if row.label == "GenRe+")
    cell = agreement_cells.measure_agreement_cell(
        checked.basis, checked.layout, row.method, checked.places[0], detector, run_stage
    )
    assert cell.metrics["box/instances"] >= 8
    assert cell.metrics["mask/instances"] == cell.metrics["box/instances"]
    for name in ("box/ap", "box/recall", "mask/iou_all"):
        assert 0 <= cell.metrics[name] <= 1
    # Quadrants that are found in both images are the same rectangle.
    assert cell.metrics["box/iou"] == pytest.approx(1.0)
    assert cell.metrics["mask/iou"] < 1
    files = write_results(request, checked, [_rename(cell, "GenRe+")], {})
    text = Path(files[1]).read_text(encoding="utf-8")
    assert f"{cell.metrics['box/ap']:.3f} / 0.785" in text
    assert "* detector: quadrants.onnx" in text


def _rename(cell: MeasuredCell, label: str) -> MeasuredCell:
    return replace(cell, method=label)


def test_the_figure_shows_the_recorded_images_and_a_row_for_each_method(tmp_path: Path, detector: str) -> None:
    checked = make_request(tmp_path, detector).check()
    one = replace(checked, layout=replace(checked.layout, rows=checked.layout.rows[-1:]))
    strips = agreement_strips(one, run_stage)
    assert [strip.label for strip in strips] == ["recorded", "GenRe+"]
    assert strips[0].captions == tuple(f"front_left_camera, frame {k}" for k in (0, 4, 7))
    with pytest.raises(InputError, match="frame 99"):
        agreement_strips(one, run_stage, frame=99)


def test_a_camera_without_images_is_named() -> None:
    class Empty:
        name = "empty"
        cameras = cached_log(LOG).cameras

        def image_bytes(self, camera: str, frame: int) -> None:
            return None

    chunk = _read_chunk()
    with pytest.raises(InputError, match="no image") as error:
        list_camera_views(Empty(), chunk, "front_left_camera")
    assert error.value.camera == "front_left_camera"


@pytest.mark.parametrize(
    ("width_px", "height_px", "size"),
    [(1550, 2048, (42, 56)), (2048, 1550, (56, 42)), (1920, 1080, (64, 36)), (32, 18, (64, 36))],
)
def test_a_camera_of_another_shape_keeps_its_shape(width_px: int, height_px: int, size: tuple[int, int]) -> None:
    lens = Lens(1700.0, 1700.0, width_px / 2, height_px / 2, width_px, height_px)

    class Rig:
        name = "rig"
        cameras = (Camera("front_left", lens),)

        def image_bytes(self, camera: str, frame: int) -> bytes:
            return b"image"

        def camera_timestamp_s(self, camera: str, frame: int) -> float:
            return 0.1 * frame

        def world_SE3_camera(self, camera: str, frame: int) -> NDArray[np.float64]:
            return np.eye(4)

    chunk = SimpleNamespace(width_px=64, height_px=36, frames=(0, 1), world_SE3_chunk=np.eye(4))
    assert choose_image_size(lens, chunk) == size
    views = list_camera_views(Rig(), chunk, "front_left")
    assert {view.lens for view in views} == {lens.resized(*size)}
    # Neither road users nor the number of pixels are far from what they are in the training camera.
    assert views[0].lens.fx_px == pytest.approx(views[0].lens.fy_px, rel=0.02)
    assert size[0] * size[1] == pytest.approx(64 * 36, rel=0.05)


def _read_chunk() -> object:
    from flows.configuration import load_configuration
    from genre_tasks.stages.ingest import ingest

    return ingest(load_configuration("demo", settings=SETTINGS).ingest, cached_log(LOG), 0)


def test_a_detector_without_masks_has_no_numbers_of_masks() -> None:
    boxes = Detections(np.array([[0, 0, 9, 9]], np.float32), np.ones(1, np.float32), np.ones(1, np.int64))
    metrics = agreement_metrics([DetectionPairs((boxes,), (boxes,), (1,))], has_masks=False)
    assert metrics["box/ap"] == 1.0
    assert not any(name.startswith("mask") for name in metrics)


@pytest.mark.parametrize(
    ("number", "detector", "words"), [(7, None, "asks a detector"), (4, "x.onnx", "asks no detector")]
)
def test_a_detector_belongs_to_table_7(number: int, detector: str | None, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        TableRequest(number, (LOG,), detector=detector).check()


def test_a_detector_without_road_users_is_refused_before_the_scenes(
    detector: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(QuadrantDetector, "class_names", ("tree", "vehicle"))
    with pytest.raises(InputError, match="knows no road users"):
        make_request(tmp_path, detector).check()


def test_a_rig_without_a_front_left_camera_is_refused(detector: str, tmp_path: Path) -> None:
    request = make_request(tmp_path, detector)
    with pytest.raises(ConfigError, match="no front-left camera"):
        replace(request, logs=(LOG.replace("cameras=2", "cameras=1"),)).check()


@pytest.mark.parametrize(
    ("train", "test", "words"),
    [((LOG,), (), "others to test on"), ((LOG,), (LOG,), "among the logs to train on and to test on")],
)
def test_mistakes_in_the_logs_of_table_8(train: tuple[str, ...], test: tuple[str, ...], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        DetectorRequest(train, test, preset="demo", settings=SETTINGS).check()


def test_the_same_log_spelled_differently_is_no_other_log() -> None:
    scheme, _, parameters = LOG.partition("?")
    turned = f"{scheme}?{'&'.join(reversed(parameters.split('&')))}"
    with pytest.raises(ConfigError, match="among the logs to train on and to test on"):
        DetectorRequest((LOG,), (turned,), preset="demo", settings=SETTINGS).check()


@pytest.mark.parametrize("steps", [0, -5, 2_000_000])
def test_a_number_of_steps_out_of_range_is_refused(steps: int) -> None:
    with pytest.raises(ConfigError, match=f"a training of {steps} steps"):
        DetectorRequest((LOG,), (OTHER,), preset="demo", settings=SETTINGS, steps=steps).check()


def test_options_of_table_8_are_refused_elsewhere() -> None:
    result = CliRunner().invoke(app, ["table", "4", LOG, "--test", LOG])
    assert isinstance(result.exception, ConfigError) and "belongs to table 8" in str(result.exception)


@pytest.mark.parametrize("option", [["--stored"], ["--detector", "x.onnx"], ["--weights", "difix=x.safetensors"]])
def test_table_8_refuses_options_that_it_has_no_use_for(option: list[str]) -> None:
    result = CliRunner().invoke(app, ["table", "8", LOG, "--test", OTHER, *option])
    assert isinstance(result.exception, ConfigError) and f"no use for {option[0]}" in str(result.exception)


def test_a_row_is_trained_and_tested_once(tmp_path: Path) -> None:
    request = DetectorRequest(
        (LOG,), (OTHER,), preset="demo", store=str(tmp_path / "store"), settings=SETTINGS, steps=2, out=str(tmp_path)
    )
    study = request.check()
    steps: list[int] = []

    def count(done: int, total: int, note: str = "") -> None:
        steps.append(done)

    first = study.measure("real+genre+", 0, run_stage, count)
    assert steps[-1] == 2
    assert set(first) == {"recorded", "shifted"}
    assert first["recorded"]["boxes"] >= 1 and 0 <= first["shifted"]["map"] <= 1
    steps.clear()
    assert study.measure("real+genre+", 0, run_stage, count) == first
    assert not steps
    study.measure("real", 0, run_stage, count)
    assert steps[-1] == 2
    folders = [path.parent for path in (tmp_path / "detectors").glob("trainings/*/scores.json")]
    assert len(folders) == 2
    # The detector itself is there for who wants to use it.
    image = np.zeros((36, 64, 3), np.uint8)
    for folder in folders:
        found = load_detector(folder / "detector.safetensors").detect(image, Lens(60.0, 60.0, 32.0, 18.0, 64, 36))
        assert np.isfinite(found.scores).all()


def test_test_logs_without_a_box_that_counts_are_refused_before_the_training(tmp_path: Path) -> None:
    request = DetectorRequest(
        (LOG,), (OTHER,), preset="demo", store=str(tmp_path / "store"), settings=SETTINGS, steps=2, out=str(tmp_path)
    )
    study = request.check()
    # Nothing is so near.
    near = replace(study, detector=study.detector.model_copy(update={"max_range_m": 0.1}))
    with pytest.raises(InputError, match="no recorded image of the logs to test on has a box of car"):
        near.measure("real", 0, run_stage)
    assert not list((tmp_path / "detectors").glob("trainings/*"))


def test_two_processes_do_not_train_the_same_detector(tmp_path: Path) -> None:
    request = DetectorRequest(
        (LOG,), (OTHER,), preset="demo", store=str(tmp_path / "store"), settings=SETTINGS, steps=2, out=str(tmp_path)
    )
    study = request.check()

    def start_another(done: int, total: int, note: str = "") -> None:
        # A lock of another object of this process is as foreign as that of another process.
        with pytest.raises(InputError, match="another process trains in this folder"):
            study.measure("real", 0, run_stage)

    first = study.measure("real", 0, run_stage, start_another)
    assert study.measure("real", 0, run_stage) == first
    assert not list((tmp_path / "detectors").glob("trainings/*/.lock"))


def test_the_page_of_table_8_has_means_ranges_and_the_papers_numbers() -> None:
    scores = {
        row: [{"recorded": {"map": a, "ap_1m": a, "ap_2m": a, "ap_4m": a}} for a in (0.1 * k, 0.1 * k + 0.02)]
        for k, row in enumerate(ROWS, 1)
    }
    text = render_page(scores, {"seeds": "2"}, "synthetic")
    assert "| Real + Sim (GenRe+) | 0.310 (0.300–0.320) / 0.277 |" in text
    assert "shift" not in text.partition("Not comparable")[0]


def test_without_images_there_is_no_agreement() -> None:
    assert math.isnan(agreement_metrics([], has_masks=False)["box/ap"])
