"""Flicker: zero where images show the same, and as large as what changes where they do not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from genre_tasks.logs.types import Lens
from genre_tasks.rollout.flicker import DepthView, FlickerMeter, WarpedDifference, measure_warped_difference
from genre_tasks.rollout.moment_actors import THIS_MOMENT, pose_actors
from genre_tasks.scene.actor_node import ActorNode
from tests.rollout.small_rollout import images_at, recorded

LENS = Lens(40.0, 40.0, 32.0, 18.0, 64, 36)
DEPTH_M = 8.0


@dataclass(frozen=True)
class Posed:
    frame: float
    chunk_SE3_camera: np.ndarray
    camera: str = "front"
    lens: Lens = LENS


def moved(x_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def wall(frame: float, x_m: float) -> DepthView:
    return DepthView(Posed(frame, moved(x_m)), torch.ones(36, 64), torch.full((36, 64), DEPTH_M))


def ramp(x_m: float) -> torch.Tensor:
    """[36, 64, 3] a wall whose colour rises along x, from a camera at ``x_m``."""
    x = (torch.arange(64) + 0.5 - LENS.cx_px) / LENS.fx_px * DEPTH_M + x_m
    return (0.5 + 0.02 * x).expand(36, 64)[..., None].expand(36, 64, 3)


def test_a_still_wall_does_not_flicker_however_the_camera_moves():
    images = (ramp(0.0), ramp(0.6))
    assert (images[0] - images[1]).abs().mean() > 0.01
    assert measure_warped_difference(images, wall(0, 0.0), wall(1, 0.6)).mean < 1e-4


def test_a_change_of_brightness_is_the_flicker():
    images = (ramp(0.0), ramp(0.6) + 0.1)
    assert measure_warped_difference(images, wall(0, 0.0), wall(1, 0.6)).mean == pytest.approx(0.1, abs=1e-3)


def test_points_on_an_actor_move_along_at_moments_between_frames():
    node = ActorNode("car", "car", (20.0, 20.0, 2.0), np.arange(3), np.stack([moved(0.8 * k) for k in range(3)]))
    node.chunk_SE3_box[:, 2, 3] = DEPTH_M
    # The wall drives along with its texture; the camera stands.
    images = (ramp(0.0), ramp(-0.4))
    pair = (wall(1.0, 0.0), wall(1.5, 0.0))
    assert measure_warped_difference(images, *pair, [node]).mean < 1e-4
    assert measure_warped_difference(images, *pair).mean > 5e-3


def test_hidden_points_do_not_count():
    near = replace(wall(1, 0.0), depth=torch.full((36, 64), 2.0))
    assert measure_warped_difference((ramp(0.0), ramp(0.0)), wall(0, 0.0), near) == WarpedDifference()


def test_an_actor_that_is_absent_has_no_pose_at_that_moment():
    node = ActorNode("car", "car", (4.0, 2.0, 1.5), np.array([2, 3]), np.stack([np.eye(4)] * 2))
    other = replace(node, track_id="inserted")
    posed = pose_actors([node, other], {THIS_MOMENT: 2.5}, recorded={"car": node}, frames=(0, 2))
    assert [a.frames.tolist() for a in posed] == [[THIS_MOMENT, 2], [THIS_MOMENT]]


def test_the_meter_compares_poses_that_follow_each_other_alone():
    images = images_at(recorded(), 1.0, 1.5, 2.0)
    meter = FlickerMeter()
    for image in images:
        meter.add(image, {"render": image.color, "blinking": image.color * (0.5 + 0.5 * (image.index % 2))})
    flicker = meter.flicker
    assert 0 < flicker["render"] < 0.05 < flicker["blinking"]
    apart = FlickerMeter()
    apart.add(images[0], {"render": images[0].color})
    apart.add(images[2], {"render": images[2].color})
    assert apart.flicker == {}


def test_a_border_of_chunks_does_not_flicker():
    first, second = images_at(recorded(), 3.0, 4.0)
    # The same image in a chunk whose origin is elsewhere.
    shift = moved(25.0)
    chunk = second.chunk_scene.chunk
    moved_chunk = replace(chunk, world_SE3_chunk=chunk.world_SE3_chunk @ np.linalg.inv(shift))
    views = tuple(replace(v, chunk_SE3_camera=shift @ v.chunk_SE3_camera) for v in second.views)
    elsewhere = replace(second, views=views, chunk_scene=replace(second.chunk_scene, chunk=moved_chunk))
    meters = (FlickerMeter(), FlickerMeter())
    for meter, following in zip(meters, (second, elsewhere), strict=True):
        meter.add(first, {"render": first.color})
        meter.add(following, {"render": following.color})
    assert meters[1].flicker["render"] == pytest.approx(meters[0].flicker["render"], rel=1e-3)
