"""Training sets in four layouts, read by their own tools and by readers written for these tests from the formats."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.registry import list_logs, open_log
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.training_sets.class_words import find_class
from genre_tasks.training_sets.kitti_writer import KITTI_CLASSES
from genre_tasks.training_sets.label_boxes import NO_SWEEP_POINTS
from genre_tasks.training_sets.labelled_images import LabelledImage
from genre_tasks.training_sets.nuscenes_tables import find_category
from genre_tasks.training_sets.reading import read_training_set
from genre_tasks.training_sets.writing import WrittenSet, training_set_formats, write_training_set
from tests.training_sets.labelled_street import LOG, distorted, label_street

ROOT = Path(__file__).resolve().parents[2]
BARREL = (-0.2, 0.02, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def street() -> list[LabelledImage]:
    return label_street(shifts_m=(3.0, -3.0))


def matrices(path: Path) -> dict[str, np.ndarray]:
    """A calibration file of KITTI."""
    rows = (line.split(":") for line in path.read_text().splitlines())
    found = {name: np.array([float(number) for number in text.split()]) for name, text in rows}
    return {name: values.reshape(3, -1) for name, values in found.items()}


def kitti_corners(height: float, width: float, length: float, bottom: np.ndarray, ry: float) -> np.ndarray:
    """[3, 8] corners as KITTI's development kit defines them: the origin is the centre of the lower face."""
    x = length / 2 * np.array([1, 1, -1, -1, 1, 1, -1, -1])
    y = height * np.array([0, 0, 0, 0, -1, -1, -1, -1])
    z = width / 2 * np.array([1, -1, -1, 1, 1, -1, -1, 1])
    turn = np.array([[math.cos(ry), 0, math.sin(ry)], [0, 1, 0], [-math.sin(ry), 0, math.cos(ry)]])
    return turn @ np.stack([x, y, z]) + bottom[:, None]


def test_kitti_boxes_project_onto_their_rectangles(street: list[LabelledImage], tmp_path: Path) -> None:
    assert write_training_set(street, tmp_path / "set", "kitti") == WrittenSet(24, sum(len(i.boxes) for i in street))
    training = tmp_path / "set" / "training"
    numbers = (tmp_path / "set/ImageSets/train.txt").read_text().split()
    assert numbers == [f"{k:06d}" for k in range(24)]
    checked = 0
    for number, image in zip(numbers, street, strict=True):
        assert np.array_equal(np.asarray(Image.open(training / f"image_2/{number}.png")), image.image)
        calib = matrices(training / f"calib/{number}.txt")
        assert set(calib) == {"P0", "P1", "P2", "P3", "R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo"}
        lines = (training / f"label_2/{number}.txt").read_text().splitlines()
        for line, box in zip(lines, image.boxes, strict=True):
            kind, *words = line.split()
            truncated, occluded, alpha, *rest = (float(word) for word in words)
            rectangle, (h, w, length), bottom, ry = rest[:4], rest[4:7], np.array(rest[7:10]), rest[10]
            assert (kind, len(rest)) == ("Car", 11) and (length, w, h) == pytest.approx(box.size_m, abs=1e-4)
            # Alpha is the turn that the camera sees: the difference is the direction of the ray.
            assert math.cos(ry - alpha - math.atan2(bottom[0], bottom[2])) == pytest.approx(1, abs=1e-6)
            assert occluded == (3 if math.isnan(box.occluded) else occluded) and -math.pi <= alpha <= math.pi
            corners = kitti_corners(h, w, length, bottom, ry)
            u, v, depth = calib["P2"] @ np.vstack([corners, np.ones(8)])
            assert corners.mean(1) == pytest.approx(box.camera_SE3_box[:3, 3], abs=1e-3)
            if truncated == 0:
                found = [(u / depth).min(), (v / depth).min(), (u / depth).max(), (v / depth).max()]
                assert found == pytest.approx(rectangle, abs=0.51)
                checked += 1
    assert checked > 20
    with (tmp_path / "set/images.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["number"], float(r["shift_m"]), r["rendered"]) for r in rows] == [
        (number, image.shift_m, str(int(image.rendered))) for number, image in zip(numbers, street, strict=True)
    ]


def test_kitti_has_the_pose_of_the_lidar(street: list[LabelledImage], tmp_path: Path) -> None:
    write_training_set(street[:1], tmp_path / "set", "kitti")
    pose = matrices(tmp_path / "set/training/calib/000000.txt")["Tr_velo_to_cam"]
    # The camera looks ahead from 0.3 m ahead of the LiDAR and 0.2 m below it.
    assert pose == pytest.approx(np.array([[0, -1, 0, 0], [0, 0, -1, -0.2], [1, 0, 0, -0.3]]), abs=1e-6)


@pytest.mark.parametrize(
    ("label", "kitti", "nuscenes"),
    [
        ("Car", "Car", "vehicle.car"),
        ("Pickup Truck", "Car", "vehicle.truck"),
        ("Semi-truck", "Truck", "vehicle.truck"),
        ("Pedestrian with Object", "Pedestrian", "human.pedestrian.adult"),
        ("TYPE_CYCLIST", "Cyclist", "vehicle.bicycle"),
        ("vehicle.car", "Car", "vehicle.car"),
        ("static_object.bicycle_rack", "Misc", "static_object.bicycle_rack"),
        ("Temporary Construction Barriers", "Misc", "movable_object.barrier"),
        ("CONSTRUCTION_CONE", "Misc", "movable_object.trafficcone"),
        ("Van", "Van", "vehicle.car"),
        ("Bus", "Truck", "vehicle.bus.rigid"),
        ("Tram / Subway", "Tram", "vehicle.bus.rigid"),
        ("Uncommon", "Misc", "Uncommon"),
    ],
)
def test_classes_follow_the_words_of_labels(label: str, kitti: str, nuscenes: str) -> None:
    assert (find_class(label, KITTI_CLASSES, "Misc"), find_category(label)) == (kitti, nuscenes)


def coco_precision(folder: Path, shift_px: float) -> float:
    """Average precision of the annotated rectangles, moved to the right, as detections."""
    from pycocotools.coco import COCO
    from pycocotools.cocoeval import COCOeval

    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(str(folder / "annotations.json"))
        found = [
            {
                "image_id": row["image_id"],
                "category_id": row["category_id"],
                "bbox": [row["bbox"][0] + shift_px, *row["bbox"][1:]],
                "score": 0.9,
            }
            for row in truth.loadAnns(truth.getAnnIds())
        ]
        evaluation = COCOeval(truth, truth.loadRes(found), "bbox")
        evaluation.evaluate()
        evaluation.accumulate()
        evaluation.summarize()
    return float(evaluation.stats[0])


def test_coco_is_evaluated_by_its_own_tools(street: list[LabelledImage], tmp_path: Path) -> None:
    out = tmp_path / "set"
    write_training_set(street, out, "coco")
    assert coco_precision(out, 0.0) == pytest.approx(1.0)
    assert coco_precision(out, 2.0) < 0.8
    tables = json.loads((out / "annotations.json").read_text())
    assert [c["name"] for c in tables["categories"]] == ["car"]
    boxes = [(number, box) for number, image in enumerate(street, 1) for box in image.boxes]
    for row, (number, box) in zip(tables["annotations"], boxes, strict=True):
        x, y, w, h = row["bbox"]
        assert (x, y, x + w, y + h) == pytest.approx(box.box_px) and row["area"] == pytest.approx(w * h)
        assert (row["image_id"], row["iscrowd"], row["track_id"]) == (number, 0, box.track_id)
    for row, image in zip(tables["images"], street, strict=True):
        pixels = np.asarray(Image.open(out / "images" / row["file_name"]))
        assert np.array_equal(pixels, image.image) and (row["height"], row["width"]) == pixels.shape[:2]


def test_coco_numbers_classes_by_name(street: list[LabelledImage], tmp_path: Path) -> None:
    images = [i for i in street if i.boxes][:2]
    labels = ("van", "bus")
    found = []
    for k, ordered in enumerate((labels, labels[::-1])):
        named = [
            replace(image, boxes=tuple(replace(box, label=label) for box in image.boxes))
            for image, label in zip(images, ordered, strict=True)
        ]
        write_training_set(named, tmp_path / str(k), "coco")
        tables = json.loads((tmp_path / str(k) / "annotations.json").read_text())
        found.append(tables["categories"])
        names = {row["id"]: row["name"] for row in tables["categories"]}
        assert [names[row["category_id"]] for row in tables["annotations"]] == [
            box.label for image in named for box in image.boxes
        ]
    assert found[0] == found[1] == [{"id": 1, "name": "bus"}, {"id": 2, "name": "van"}]


def test_nuscenes_is_read_by_the_reader_of_nuscenes(street: list[LabelledImage], tmp_path: Path) -> None:
    out = tmp_path / "set"
    write_training_set(street, out, "nuscenes")
    assert list_logs(f"nuscenes:{out}/*") == [
        f"nuscenes:{out}/street-{name}" for name in ("left-3m", "recorded", "right-3m")
    ]
    for name, shift_m in (("recorded", 0.0), ("left-3m", 3.0), ("right-3m", -3.0)):
        log = open_log(f"nuscenes:{out}/street-{name}")
        images = [i for i in street if i.shift_m == shift_m]
        assert log.frame_count == 4 and {c.name for c in log.cameras} == {"CAM_FRONT", "CAM_LEFT"}
        poses = [(int(f), p) for t in log.tracks() for f, p in zip(t.frames, t.world_SE3_box, strict=True)]
        assert {(t.label, t.size_m) for t in log.tracks()} == {("vehicle.car", (4.0, 1.8, 1.5))}
        for image in images:
            camera = f"CAM_{image.camera.upper()}"
            assert log.world_SE3_camera(camera, image.frame) == pytest.approx(image.world_SE3_camera, abs=1e-6)
            assert log.world_SE3_lidar(image.frame) == pytest.approx(image.world_SE3_ego, abs=1e-6)
            assert log.camera_timestamp_s(camera, image.frame) == pytest.approx(image.timestamp_s, abs=1e-6)
            lens = next(c.lens for c in log.cameras if c.name == camera)
            assert lens == image.lens
            data = log.image_bytes(camera, image.frame)
            assert data and np.array_equal(decode_pixels(data, lens.width_px, lens.height_px), image.image)
            for box in image.boxes:
                expected = image.world_SE3_camera @ box.camera_SE3_box
                assert min(np.abs(pose - expected).max() for frame, pose in poses if frame == image.frame) < 1e-6


def test_nuscenes_tables_point_to_one_another(street: list[LabelledImage], tmp_path: Path) -> None:
    write_training_set(street, tmp_path / "set", "nuscenes")
    folder = tmp_path / "set/v1.0-trainval"
    tables = {path.stem: {row["token"]: row for row in json.loads(path.read_text())} for path in folder.iterdir()}
    assert len(tables) == 13 and len(tables["scene"]) == 3 and len(tables["sample"]) == 12
    links = {"first_sample": "sample", "last_sample": "sample", "first_annotation": "sample_annotation"}
    links["last_annotation"] = "sample_annotation"
    for name, rows in tables.items():
        for row in rows.values():
            for column, value in row.items():
                if column.endswith("_token"):
                    target = column.removesuffix("_token")
                    assert value in tables[links.get(target, target)], (name, column)
                if column in ("prev", "next") and value:
                    assert rows[value]["next" if column == "prev" else "prev"] == row["token"]
    mapped = {token for row in tables["map"].values() for token in row["log_tokens"]}
    assert mapped == set(tables["log"])
    for row in tables["map"].values():
        assert (tmp_path / "set" / row["filename"]).is_file()
    moving = {row["name"]: row["token"] for row in tables["attribute"].values()}
    states = {(tuple(r["size"]), tuple(r["attribute_tokens"])) for r in tables["sample_annotation"].values()}
    # Width, length and height, in nuScenes' order.
    assert states == {((1.8, 4.0, 1.5), (moving[f"vehicle.{state}"],)) for state in ("moving", "parked")}
    assert {r["num_lidar_pts"] > 0 for r in tables["sample_annotation"].values()} == {True}


def test_nuscenes_takes_no_image_twice(street: list[LabelledImage], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two images of one camera and frame"):
        write_training_set([street[0], street[0]], tmp_path / "set", "nuscenes")
    assert list(tmp_path.iterdir()) == []


def test_nuscenes_has_one_calibration_of_a_camera(street: list[LabelledImage], tmp_path: Path) -> None:
    first, second = [i for i in street if i.camera == "front" and not i.rendered][:2]
    larger = replace(second.lens, fx_px=2 * second.lens.fx_px)
    small = replace(second, lens=second.lens.resized(48, 32), image=second.image[::2, ::2])
    for other in (replace(second, lens=larger), small):
        with pytest.raises(InputError, match=r"different sizes or intrinsics.*front, frame 1.*a set for each run"):
            write_training_set([first, other], tmp_path / "set", "nuscenes")
    # The same lens, rectified.
    assert write_training_set([first, *distorted([second], BARREL)], tmp_path / "set", "nuscenes").images == 2


def test_nuscenes_refuses_two_cameras_of_one_name(street: list[LabelledImage], tmp_path: Path) -> None:
    images = [replace(i, camera={"front": "front camera", "left": "front-camera"}[i.camera]) for i in street]
    with pytest.raises(InputError, match=r"front camera and front-camera are both CAM_FRONT in nuScenes.*Rename one"):
        write_training_set(images, tmp_path / "set", "nuscenes")
    assert list(tmp_path.iterdir()) == []


def test_nuscenes_keeps_boxes_of_frames_without_sweeps(street: list[LabelledImage], tmp_path: Path) -> None:
    image = next(i for i in street if len(i.boxes) > 2)
    counts = (NO_SWEEP_POINTS, 0, 7)
    boxes = tuple(replace(box, lidar_points=n) for box, n in zip(image.boxes, counts, strict=False))
    write_training_set([replace(image, boxes=boxes)], tmp_path / "set", "nuscenes")
    rows = json.loads((tmp_path / "set/v1.0-trainval/sample_annotation.json").read_text())
    # nuScenes' development kit leaves out boxes with 0.
    assert [row["num_lidar_pts"] for row in rows] == [1, 0, 7]


@pytest.mark.parametrize("layout", ["kitti", "nuscenes"])
def test_layouts_without_distortion_get_rectified_images(
    street: list[LabelledImage], tmp_path: Path, layout: str
) -> None:
    write_training_set(distorted(street[:1], BARREL), tmp_path / "set", layout)
    (path,) = [path for path in (tmp_path / "set").rglob("*.png") if path.parent.name != "maps"]
    pixels = np.asarray(Image.open(path))
    assert pixels.shape == street[0].image.shape and not np.array_equal(pixels, street[0].image)


def test_parquet_sets_are_read_back(street: list[LabelledImage], tmp_path: Path) -> None:
    out = tmp_path / "set"
    images = [*distorted(street[:1], BARREL), replace(street[1], boxes=()), *street[2:]]
    write_training_set(images, out, "own")
    again = read_training_set(out)
    assert len(again) == len(images)
    for before, after in zip(images, again, strict=True):
        for name in ("log", "camera", "frame", "timestamp_s", "shift_m", "rendered", "lens"):
            assert getattr(before, name) == getattr(after, name)
        for name in ("world_SE3_camera", "world_SE3_ego", "image"):
            assert np.array_equal(getattr(before, name), getattr(after, name))
        assert len(before.boxes) == len(after.boxes)
        for one, other in zip(before.boxes, after.boxes, strict=True):
            assert np.array_equal(one.camera_SE3_box, other.camera_SE3_box)
            assert other.occluded == one.occluded or (math.isnan(one.occluded) and math.isnan(other.occluded))
            # Equal but for the two that need a comparison of their own.
            blank = {"camera_SE3_box": np.eye(4), "occluded": 0.0}
            assert vars(replace(one, **blank)).keys() == vars(other).keys()
            for name in ("track_id", "label", "size_m", "box_px", "truncated", "lidar_points", "velocity_m_s"):
                assert getattr(one, name) == getattr(other, name)
    described = json.loads((out / "training_set.json").read_text())["columns"]
    assert list(described["boxes.parquet"]) == pq.read_schema(out / "boxes.parquet").names
    assert list(described["images.parquet"]) == pq.read_schema(out / "images.parquet").names


def test_images_of_a_parquet_set_are_read_when_they_are_asked_for(street: list[LabelledImage], tmp_path: Path) -> None:
    out = tmp_path / "set"
    write_training_set(street[:2], out, "own")
    first, second = read_training_set(out)
    next((out / "images").glob("000000_*")).unlink()
    assert np.array_equal(replace(second, frame=7).image, street[1].image)
    with pytest.raises(InputError, match=r"000000_street_recorded_front_000000\.png"):
        _ = first.image
    (out / "boxes.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"table cannot be read.*boxes\.parquet"):
        read_training_set(out)
    with pytest.raises(InputError, match=r"description of the training set cannot be read.*genre augment"):
        read_training_set(tmp_path)


def test_a_damaged_table_is_one_error_and_opens_no_file_elsewhere(street: list[LabelledImage], tmp_path: Path) -> None:
    out = tmp_path / "set"
    write_training_set(street[:1], out, "own")
    images, boxes = pq.read_table(out / "images.parquet"), pq.read_table(out / "boxes.parquet")
    wrong_images = {
        "row 0 names a file outside": ("file", ["../secret.png"]),
        "row 0 is no image": ("world_SE3_ego", [[math.nan] * 16]),
        "values are missing in fx_px": ("fx_px", pa.nulls(1, pa.float64())),
        "a box is of image 0, which is not there": ("image", [7]),
    }
    for text, (name, values) in wrong_images.items():
        pq.write_table(images.set_column(images.column_names.index(name), name, [values]), out / "images.parquet")
        with pytest.raises(InputError, match=rf"{text}.*images\.parquet.*Write the set again"):
            read_training_set(out)
    pq.write_table(images, out / "images.parquet")
    pq.write_table(boxes.drop_columns(["label"]), out / "boxes.parquet")
    with pytest.raises(InputError, match=r"lacks the columns label.*boxes\.parquet"):
        read_training_set(out)


@pytest.mark.parametrize("layout", training_set_formats())
def test_a_write_that_fails_leaves_nothing(street: list[LabelledImage], tmp_path: Path, layout: str) -> None:
    def broken() -> Iterator[LabelledImage]:
        yield street[0]
        raise InputError("the log broke off", remedy="Copy it again.")

    with pytest.raises(InputError, match="broke off"):
        write_training_set(broken(), tmp_path / "set", layout)
    with pytest.raises(InputError, match=r"no image to write.*set"):
        write_training_set([], tmp_path / "set", layout)
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").touch()
    with pytest.raises(InputError, match=r"holds something already.*full"):
        write_training_set(street, tmp_path / "full", layout)
    (tmp_path / "empty").mkdir()
    assert write_training_set(street[:1], tmp_path / "empty", layout).images == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "full"]


def test_a_killed_write_leaves_no_set_and_the_next_one_tidies_up(street: list[LabelledImage], tmp_path: Path) -> None:
    code = f"""
import os, signal, sys
from pathlib import Path
from genre_tasks.training_sets.writing import write_training_set
from tests.training_sets.labelled_street import label_street
def killed():
    yield from label_street()[:2]
    os.kill(os.getpid(), signal.SIGKILL)
write_training_set(killed(), Path({str(tmp_path / "set")!r}), "kitti")
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, check=False)
    assert done.returncode == -signal.SIGKILL
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(".set.") and len(list(left.rglob("*.png"))) == 2
    write_training_set(street[:1], tmp_path / "set", "kitti")
    assert [path.name for path in tmp_path.iterdir()] == ["set"]


def test_images_are_taken_one_at_a_time(street: list[LabelledImage], tmp_path: Path) -> None:
    written: list[int] = []

    def counted() -> Iterator[LabelledImage]:
        for image in street[:4]:
            written.append(len(list(tmp_path.rglob("*.png"))))
            yield image

    write_training_set(counted(), tmp_path / "set", "coco")
    assert written == [0, 1, 2, 3]


def test_a_mistyped_format_is_named(street: list[LabelledImage], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"'nuscene'. Did you mean 'nuscenes'\? Known: coco, kitti, nuscenes, own"):
        write_training_set(street, tmp_path / "set", "nuscene")
    assert LOG.name == street[0].log
