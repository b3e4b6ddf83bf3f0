"""The truth of edited traffic: it changes where the edit is, and nowhere else."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from genre_tasks.errors import InputError
from genre_tasks.logs.synthetic import SyntheticStreet, open_synthetic
from genre_tasks.logs.synthetic import traffic_edits as edits
from genre_tasks.logs.synthetic.edited_truth import EditedStreet, TruthView, find_changed_pixels
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S
from genre_tasks.logs.synthetic.street_layout import StreetLayout


@dataclass(frozen=True)
class Recorded:
    log: SyntheticStreet
    layout: StreetLayout
    street: EditedStreet
    view: TruthView
    name: str

    def edited(self, layout: StreetLayout) -> EditedStreet:
        return EditedStreet(self.log, layout)


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    log = open_synthetic("street?seed=905&frames=8&cameras=3&width=64&height=36&samples=1&lidar=0")
    layout = edits.build_street_layout(log)
    street = EditedStreet(log, layout)
    found = []
    for camera in log.cameras:
        view = TruthView(4, log.world_SE3_camera(camera.name, 4), camera.lens)
        for actor in layout.actors:
            area = street.mask_actors(view, [actor.name])
            found.append((int(area.sum()), actor.name, view))
    # The largest actor in any image.
    area, name, view = max(found, key=lambda item: item[0])
    assert area > 20
    return Recorded(log, layout, street, view, name)


def _shift(x: float, y: float = 0.0) -> np.ndarray:
    out = np.eye(4)
    out[:3, 3] = (x, y, 0.0)
    return out


def test_without_an_edit_the_image_is_the_logs(recorded: Recorded) -> None:
    view = recorded.view
    expected = recorded.log.truth.image(4, view.world_SE3_camera, view.lens)
    np.testing.assert_array_equal(recorded.street.image(view), expected)


def test_removing_an_actor_changes_its_pixels_and_its_shadow_alone(recorded: Recorded) -> None:
    without = recorded.edited(edits.remove_actor(recorded.layout, recorded.name))
    changed = find_changed_pixels(recorded.street, without, recorded.view)
    area = recorded.street.mask_actors(recorded.view, [recorded.name])
    assert not without.mask_actors(recorded.view, [recorded.name]).any()
    # Behind a car there is hardly ever a pixel of its own colour.
    assert (changed & area).sum() >= 0.9 * area.sum()
    # What else changes is in the shadow of the actor, thus brighter without it.
    shadow = changed & ~area
    before = recorded.street.image(recorded.view).astype(int)
    after = without.image(recorded.view).astype(int)
    assert (after >= before)[shadow].all()
    assert (changed | (after == before).all(2)).all()


def test_moving_an_actor_there_and_back_gives_the_same_image(recorded: Recorded) -> None:
    away = edits.move_actor(recorded.layout, recorded.name, _shift(-3.0, 1.0))
    back = edits.move_actor(away, recorded.name, _shift(3.0, -1.0))
    assert find_changed_pixels(recorded.street, recorded.edited(away), recorded.view).any()
    np.testing.assert_array_equal(recorded.edited(back).image(recorded.view), recorded.street.image(recorded.view))


def test_half_a_turn_keeps_the_actor_on_its_place(recorded: Recorded) -> None:
    turned = edits.rotate_actor(recorded.layout, recorded.name, np.pi)
    pose = edits.find_actor(turned, recorded.name).street_SE3_actor(np.array([0.4]))[0]
    before = edits.find_actor(recorded.layout, recorded.name).street_SE3_actor(np.array([0.4]))[0]
    np.testing.assert_allclose(pose[:3, 3], before[:3, 3], atol=1e-9)
    np.testing.assert_allclose(pose[:3, 0], -before[:3, 0], atol=1e-9)
    assert find_changed_pixels(recorded.street, recorded.edited(turned), recorded.view).any()


def test_a_later_or_slower_actor_is_where_it_was_at_another_time(recorded: Recorded) -> None:
    motion = edits.find_actor(recorded.layout, "car-0").street_SE3_actor
    times = np.array([0.2, 0.5])
    later = edits.find_actor(edits.retime_actor(recorded.layout, "car-0", 0.3), "car-0")
    np.testing.assert_allclose(later.street_SE3_actor(times), motion(times - 0.3))
    slower = edits.find_actor(edits.scale_actor_speed(recorded.layout, "car-0", 0.5, pivot_s=0.4), "car-0")
    np.testing.assert_allclose(slower.street_SE3_actor(times), motion(0.4 + 0.5 * (times - 0.4)))


def test_limbs_keep_their_actors_clock() -> None:
    layout = edits.build_street_layout(open_synthetic("street?seed=905&frames=4&stride=1&lidar=0"))
    name = "pedestrian-0"
    limbs = [part for part in edits.find_actor(layout, name).parts if part.actor_SE3_part is not None]
    retimed = edits.find_actor(edits.retime_actor(layout, name, 0.3), name)
    later = [part for part in retimed.parts if part.actor_SE3_part is not None]
    assert limbs
    for before, after in zip(limbs, later, strict=True):
        np.testing.assert_allclose(after.actor_SE3_part(np.array([0.5])), before.actor_SE3_part(np.array([0.2])))


def test_a_copy_along_the_boxes_of_a_removed_actor_is_that_actor(recorded: Recorded) -> None:
    log = recorded.log
    track = next(track for track in log.tracks() if track.track_id == recorded.name)
    motion = edits.follow_boxes(track.frames, track.world_SE3_box, track.size_m[2], log.offset_m)
    actor = edits.find_actor(recorded.layout, recorded.name)
    np.testing.assert_allclose(
        motion(track.frames * FRAME_S), actor.street_SE3_actor(track.frames * FRAME_S), atol=1e-9
    )
    without = edits.remove_actor(recorded.layout, recorded.name)
    copy = recorded.edited(edits.insert_actor(without, actor, "copy", motion))
    difference = np.abs(copy.image(recorded.view).astype(int) - recorded.street.image(recorded.view))
    # Rounding of a pose may move an edge over the middle of a pixel, but not over many.
    assert (difference.max(2) > 2).sum() <= 2
    area = recorded.street.mask_actors(recorded.view, [recorded.name])
    assert (copy.mask_actors(recorded.view, ["copy"]) != area).sum() <= 2


def test_boxes_between_frames_are_interpolated(recorded: Recorded) -> None:
    boxes = np.stack([np.eye(4), np.eye(4)])
    boxes[1, :3, 3] = (2.0, 0.0, 1.0)
    motion = edits.follow_boxes([3, 5], boxes, 1.0, np.zeros(3))
    np.testing.assert_allclose(motion(np.array([0.4]))[0, :3, 3], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(motion(np.array([0.0, 9.9]))[:, :3, 3], [[0, 0, -0.5], [2, 0, 0.5]])


def test_background_is_recorded_where_the_way_to_it_is_free(recorded: Recorded) -> None:
    without = recorded.edited(edits.remove_actor(recorded.layout, recorded.name))
    points, is_still = without.find_background(recorded.view)
    area = recorded.street.mask_actors(recorded.view, [recorded.name])
    assert is_still.any() and area.sum() > 20
    itself = recorded.street.find_recorded_points(points, [recorded.view])
    assert not itself[area].any(), "the camera sees the actor there, not what is behind it"
    others = is_still & ~area
    assert itself[others].mean() > 0.99
    assert without.find_recorded_points(points, [recorded.view])[is_still].mean() > 0.99
    turned = TruthView(4, recorded.view.world_SE3_camera @ np.diag([-1.0, 1.0, -1.0, 1.0]), recorded.view.lens)
    assert not recorded.street.find_recorded_points(points, [turned]).any()


def test_errors_name_the_actor(recorded: Recorded) -> None:
    with pytest.raises(InputError, match=r"no actor 'car-00'.*Did you mean 'car-0'"):
        edits.remove_actor(recorded.layout, "car-00")
    actor = recorded.layout.actors[0]
    with pytest.raises(InputError, match=f"actor '{actor.name}' already"):
        edits.insert_actor(recorded.layout, actor, actor.name, actor.street_SE3_actor)
    with pytest.raises(InputError, match="needs a pose"):
        edits.follow_boxes([], np.zeros((0, 4, 4)), 1.0, np.zeros(3))
    bad = TruthView(0, np.full((4, 4), np.nan), recorded.view.lens)
    with pytest.raises(InputError, match="finite pose"):
        recorded.street.image(bad)
