"""Targets of the detector: they decode to the boxes they were made of, mirrored and zoomed too."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from genre_tasks.detection3d.augmentation import (
    Batch,
    Changes,
    apply_changes,
    draw_changes,
    jitter_colours,
    take_batch,
)
from genre_tasks.detection3d.decode import Detections3d, decode_boxes, find_peaks
from genre_tasks.detection3d.examples import build_examples, observation_angle, project_centre, select_boxes
from genre_tasks.detection3d.settings import Detector3dConfig
from genre_tasks.detection3d.targets import build_targets
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Lens
from tests.detection3d.labelled import LENS, TINY, labelled_box, labelled_image

NONE = Changes(torch.tensor([False]), torch.ones(1), torch.zeros(1, 2))
BOXES = (
    labelled_box(1.0, 12.0, 0.4),
    labelled_box(-5.0, 15.0, -2.5),
    labelled_box(4.0, 30.0, 1.5, size_m=(4.9, 2.0, 2.1)),
    labelled_box(-1.0, 9.0, 3.0, label="Pedestrian", size_m=(0.7, 0.6, 1.6)),
)


def decode_targets(batch: Batch, lens: Lens, config: Detector3dConfig = TINY) -> Detections3d:
    """What a network that answers exactly as it should finds in the batch's only image."""
    targets = build_targets(batch, config)
    peaks = find_peaks(targets.heat[0], config.max_detections)
    peaks = replace(
        peaks,
        heights=peaks.heights[peaks.heights == 1],
        classes=peaks.classes[peaks.heights == 1],
        cells=peaks.cells[peaks.heights == 1],
    )
    rows = [torch.nonzero((targets.cells == cell).all(1))[0, 0] for cell in peaks.cells]
    chosen = torch.stack(rows)
    values = {name: value[chosen] for name, value in vars(targets.regressions).items()}
    values["log_spreads"] = torch.linspace(-8, -4, len(chosen))
    return decode_boxes(peaks, type(targets.regressions)(**values), lens, config)


def changed_lens(batch: Batch, lens: Lens) -> Lens:
    fx, fy, cx, cy = batch.lenses[0].tolist()
    return replace(lens, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy)


def find(detections: Detections3d, centre: np.ndarray) -> int:
    return int(np.argmin(np.linalg.norm(detections.camera_SE3_box[:, :3, 3] - centre, axis=1)))


@pytest.mark.parametrize("lens", [LENS, replace(LENS, distortion=(-0.05, 0.01, 0.001, 0.0, 0.0))])
def test_targets_decode_to_the_boxes(lens: Lens) -> None:
    batch = take_batch(build_examples([labelled_image(*BOXES, lens=lens)], TINY), torch.tensor([0]))
    found = decode_targets(batch, lens)
    assert len(found) == len(BOXES)
    for box in BOXES:
        n = find(found, box.camera_SE3_box[:3, 3])
        centre = found.camera_SE3_box[n, :3, 3]
        wanted = np.array(project_centre(box.camera_SE3_box[:3, 3], lens))
        assert np.abs(np.array(project_centre(centre, lens)) - wanted).max() < 1e-3
        assert centre[2] == pytest.approx(box.camera_SE3_box[2, 3], rel=1e-4)
        assert found.sizes_m[n] == pytest.approx(box.size_m, rel=1e-4)
        assert np.abs(found.camera_SE3_box[n] - box.camera_SE3_box).max() < 1e-2
        assert found.classes[n] == (box.label == "Pedestrian")


def test_images_of_another_size_decode_to_their_own_lens() -> None:
    lens = LENS.resized(160, 100)
    batch = take_batch(build_examples([labelled_image(*BOXES, lens=lens)], TINY), torch.tensor([0]))
    found = decode_targets(batch, lens)
    for box in BOXES:
        n = find(found, box.camera_SE3_box[:3, 3])
        # The scaled image's height is rounded: its two focal lengths differ by a percent.
        assert found.camera_SE3_box[n, :3, 3] == pytest.approx(box.camera_SE3_box[:3, 3], rel=0.01)


def test_a_mirrored_image_shows_mirrored_boxes() -> None:
    image = labelled_image(*BOXES)
    batch = take_batch(build_examples([image], TINY), torch.tensor([0]))
    flipped = apply_changes(batch, replace(NONE, flipped=torch.tensor([True])))
    assert torch.allclose(flipped.images, batch.images.flip(3), atol=1e-5)
    found = decode_targets(flipped, changed_lens(flipped, LENS))
    mirror = np.diag([-1.0, 1.0, 1.0])
    for box in BOXES:
        n = find(found, mirror @ box.camera_SE3_box[:3, 3])
        assert found.camera_SE3_box[n, :3, 3] == pytest.approx(mirror @ box.camera_SE3_box[:3, 3], rel=1e-3)
        assert found.camera_SE3_box[n, :3, 0] == pytest.approx(mirror @ box.camera_SE3_box[:3, 0], abs=1e-3)
        # Its left side is on the other side now; rotations stay rotations.
        assert np.linalg.det(found.camera_SE3_box[n, :3, :3]) == pytest.approx(1.0)


def test_a_zoom_changes_the_lens_and_not_the_depth() -> None:
    batch = take_batch(build_examples([labelled_image(*BOXES[:2])], TINY), torch.tensor([0]))
    changes = Changes(torch.tensor([False]), torch.tensor([1.25]), torch.tensor([[2.0, -3.0]]))
    zoomed = apply_changes(batch, changes)
    found = decode_targets(zoomed, changed_lens(zoomed, LENS))
    for box in BOXES[:2]:
        n = find(found, box.camera_SE3_box[:3, 3])
        assert found.camera_SE3_box[n, :3, 3] == pytest.approx(box.camera_SE3_box[:3, 3], rel=1e-3)
    # The pixels move with the labels: the bright box's middle is where its centre is.
    single = take_batch(build_examples([labelled_image(BOXES[0])], TINY), torch.tensor([0]))
    moved = apply_changes(single, replace(changes, flipped=torch.tensor([True])))
    rows, columns = torch.nonzero(moved.images[0, 0] > 0.6, as_tuple=True)
    middle = torch.tensor([columns.float().mean() + 0.5, rows.float().mean() + 0.5])
    assert (middle - moved.objects.centres_px[0]).abs().max() < 0.7


def test_objects_that_leave_the_image_are_dropped() -> None:
    batch = take_batch(build_examples([labelled_image(*BOXES)], TINY), torch.tensor([0]))
    moved = apply_changes(batch, replace(NONE, shifts_px=torch.tensor([[30.0, 0.0]])))
    assert 0 < len(moved.objects) < len(BOXES)
    build_targets(moved, TINY)


def test_batches_keep_the_objects_of_their_images() -> None:
    images = [labelled_image(BOXES[0]), labelled_image(), labelled_image(*BOXES[1:])]
    # Without objects of its own, an image still has its place.
    batch = take_batch(build_examples(images, TINY), torch.tensor([2, 1, 0, 2]))
    assert batch.objects.images.tolist() == [0, 0, 0, 2, 3, 3, 3]
    assert batch.objects.depths_m[3] == 12.0


def test_changes_stay_in_their_range() -> None:
    config = TINY.model_copy(update={"zoom": 0.25, "shift": 0.1, "flip": 0.5})
    changes = draw_changes(500, config, torch.Generator().manual_seed(0))
    assert changes.zooms.min() >= 1 / 1.25 - 1e-6 and changes.zooms.max() <= 1.25 + 1e-6
    assert changes.shifts_px.abs().amax(0).tolist() == pytest.approx([6.4, 4.8], rel=0.02)
    assert 0.4 < changes.flipped.float().mean() < 0.6


def test_colours_change_and_boxes_do_not() -> None:
    batch = take_batch(build_examples([labelled_image(*BOXES)], TINY), torch.tensor([0]))
    changed = jitter_colours(batch, 0.3, torch.Generator().manual_seed(1))
    assert not torch.equal(changed.images, batch.images)
    assert changed.images.min() >= 0 and changed.images.max() <= 1
    assert changed.objects is batch.objects


def test_boxes_that_nobody_can_see_do_not_count() -> None:
    boxes = {
        "good": labelled_box(0.0),
        "no points": labelled_box(1.0, lidar_points=0),
        "no sweep": labelled_box(2.0, lidar_points=-1),
        "far": labelled_box(3.0, 60.0),
        "behind": labelled_box(0.0, -15.0),
        "outside": labelled_box(-30.0, 15.0),
        "hidden": labelled_box(0.5, occluded=0.95),
        "other": labelled_box(0.5, label="Tree"),
    }
    config = TINY.model_copy(update={"max_occluded": 0.9})
    chosen = [box for _, box in select_boxes(labelled_image(*boxes.values()), config)]
    assert chosen == [boxes["good"], boxes["no sweep"]]


def test_the_observation_angle_is_what_the_image_shows() -> None:
    # Two cars that turn the same side to the camera, in different directions.
    ahead = labelled_box(0.0, 20.0, heading=0.5)
    aside = labelled_box(20.0, 20.0, heading=0.5 + np.pi / 4)
    angles = [observation_angle(box.camera_SE3_box) for box in (ahead, aside)]
    assert angles == pytest.approx([0.5, 0.5])


def test_errors_name_the_image() -> None:
    pose = np.full((4, 4), np.nan)
    image = labelled_image(frame=7)
    broken = replace(image, boxes=(replace(BOXES[0], camera_SE3_box=pose),))
    with pytest.raises(InputError, match="not finite") as caught:
        build_examples([broken], TINY)
    assert (caught.value.log, caught.value.camera, caught.value.frame) == ("street", "front_camera", 7)
    with pytest.raises(InputError, match="no training images"):
        build_examples([], TINY)
    with pytest.raises(InputError, match="no training image has a box of car, pedestrian"):
        build_examples([image], TINY)
