"""Recorded images looked up from beside the path: geometry, what hides what, actors, which images are looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from genre_tasks.fixer.view_surface import Surface, unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source, select_sources, warp
from genre_tasks.logs.types import Lens, RollingShutter
from genre_tasks.scene.chunk import Actor, Points

HEIGHT, WIDTH = 24, 40
LENS = Lens(30.0, 30.0, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
NO_POINTS = Points(
    np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.bool_), np.zeros(0, np.int16)
)


def at(x: float = 0.0, z: float = 0.0) -> np.ndarray:
    pose = np.eye(4)
    pose[0, 3], pose[2, 3] = x, z
    return pose


def source(pose: np.ndarray, frame: int = 0, seed: int = 0, depth: torch.Tensor | float = 0.0) -> SourceImage:
    image = torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
    depth = depth if isinstance(depth, torch.Tensor) else torch.full((HEIGHT, WIDTH), depth)
    return SourceImage("front", frame, pose, LENS, image, depth)


def plane(depth: float | torch.Tensor, pose: np.ndarray | None = None, actors: tuple[Actor, ...] = ()) -> Surface:
    full = torch.full((HEIGHT, WIDTH), 1.0) * depth
    return unproject_surface(full, torch.ones(HEIGHT, WIDTH), at() if pose is None else pose, LENS, actors, 0)


def test_the_same_viewpoint_shows_the_image_itself():
    image = source(at())
    color, seen = sample_source(plane(7.0), image, (), 0)
    torch.testing.assert_close(color, image.image, atol=1e-5, rtol=0)
    assert seen.all()


def test_a_lens_bends_both_ways():
    bent = replace(LENS, distortion=(-0.2, 0.02, 0.001, -0.002, 0.0))
    same = unproject_surface(torch.full((HEIGHT, WIDTH), 7.0), torch.ones(HEIGHT, WIDTH), at(), bent, (), 0)
    image = replace(source(at()), lens=bent)
    color, seen = sample_source(same, image, (), 0)
    torch.testing.assert_close(color, image.image, atol=1e-4, rtol=0)
    assert seen.all() and float((same.points - plane(7.0).points).abs().max()) > 0.1
    assert not torch.allclose(sample_source(plane(7.0), image, (), 0)[0], image.image, atol=0.1)
    folded = replace(bent, distortion=(-0.9, 0.0, 0.0, 0.0, 0.0))  # r (1 - 0.9 r²) is 0 at 1.05
    beside = Surface(torch.tensor([[[1.05, 0.0, 1.0]]]), torch.ones(1, 1, dtype=torch.bool), torch.full((1, 1), -1))
    assert not sample_source(beside, replace(image, lens=folded), (), 0)[1].any()


def test_rows_are_looked_up_where_the_camera_then_was():
    """A plane at 10 m with a smooth colour, recorded row by row while the camera moves to the right and turns."""
    moving = RollingShutter(0.05, velocity_m_s=(8.0, 0.0, 2.0), turn_rad_s=(0.0, 0.3, 0.0))

    def colour(points: torch.Tensor) -> torch.Tensor:
        return torch.stack([(points[..., k] * 1.3 + k).sin() for k in (0, 1, 0)]) * 0.4 + 0.5

    rows = []
    for row in range(HEIGHT):
        time = ((row + 0.5) / HEIGHT - 0.5) * moving.readout_s
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(np.array(moving.turn_rad_s) * time).as_matrix()
        pose[:3, 3] = np.array(moving.velocity_m_s) * time
        v, u = torch.tensor([row + 0.5]), torch.arange(WIDTH) + 0.5
        ray = torch.stack(
            [(u - LENS.cx_px) / LENS.fx_px, ((v - LENS.cy_px) / LENS.fy_px).expand(WIDTH), torch.ones(WIDTH)]
        )
        ray = torch.tensor(pose[:3, :3]).float() @ ray
        hit = torch.tensor(pose[:3, 3:]).float() + ray * (10.0 - float(pose[2, 3])) / ray[2]
        rows.append(colour(hit.T))
    image = replace(source(at()), image=torch.stack(rows, 1), shutter=moving)
    surface, inner = plane(10.0), (slice(None), slice(2, -2), slice(3, -3))
    right, seen = sample_source(surface, image, (), 0)
    wrong, _ = sample_source(surface, replace(image, shutter=None), (), 0)
    true = colour(surface.points)
    assert seen[inner[1:]].all()
    off, before = (float((x - true)[inner].abs().max()) for x in (right, wrong))
    assert off < 0.02 and before > 10 * off


def test_a_plane_moves_by_its_disparity():
    # the view stands 2 m to the right; a plane at 10 m is 30 · 2 / 10 = 6 pixels further left in it
    image = source(at())
    out = warp(plane(10.0, at(2.0)), [image], (), 0)
    torch.testing.assert_close(out.color[..., :34], image.image[..., 6:], atol=1e-4, rtol=0)
    assert out.mask[..., :34].all() and not out.mask[..., 34:].any() and not out.color[..., 34:].any()


def test_unknown_depth_and_thin_renders_show_nothing():
    depth, alpha = torch.full((HEIGHT, WIDTH), 10.0), torch.ones(HEIGHT, WIDTH)
    depth[:, 0], depth[:, 1], depth[:, 2], alpha[:, 3] = 0, float("nan"), float("inf"), 0.2
    out = warp(unproject_surface(depth, alpha, at(), LENS, (), 0), [source(at())], (), 0)
    assert torch.isfinite(out.color).all()
    assert not out.mask[..., :4].any() and out.mask[..., 4:].all()


def test_what_lies_behind_a_camera_is_not_seen():
    out = warp(plane(5.0), [source(at(z=20.0))], (), 0)
    assert not out.mask.any() and torch.isfinite(out.color).all()


def test_what_a_source_sees_something_nearer_before_is_hidden():
    depth = torch.full((HEIGHT, WIDTH), 20.0)
    depth[:, 10:14] = 4.0  # a post; what the source has no depth for hides nothing
    depth[:, 30:] = 0.0
    _, seen = sample_source(plane(20.0), source(at(), depth=depth), (), 0)
    assert not seen[:, 10:14].any() and seen[:, :10].all() and seen[:, 14:].all()


def test_what_floats_before_what_a_source_sees_takes_no_colour():
    depth = torch.full((HEIGHT, WIDTH), 20.0)
    depth[:, 10:14] = 11.0  # a wall just behind the point: LiDAR met it between the wires of a fence
    depth[:, 30:] = 0.0
    _, seen = sample_source(plane(10.0), source(at(), depth=depth), (), 0)
    assert seen[:, 10:14].all() and seen[:, 30:].all() and not seen[:, :10].any() and not seen[:, 14:30].any()


def test_a_pixel_is_taken_from_the_first_image_that_sees_it_and_others_are_compared():
    blind = torch.zeros(HEIGHT, WIDTH)
    blind[:, :20] = 2.0  # something stands before the left half
    first, second, third = source(at(), 0, 1, blind), source(at(), 1, 2), source(at(), 2, 2)
    out = warp(plane(10.0), [first, second, third], (), 0)
    assert out.mask.all()
    torch.testing.assert_close(out.color[..., 20:], first.image[..., 20:], atol=1e-5, rtol=0)
    torch.testing.assert_close(out.color[..., :20], second.image[..., :20], atol=1e-5, rtol=0)
    assert out.spread[..., :20].abs().max() < 1e-5  # the third agrees with the second
    differing = (second.image - first.image).abs().mean(0)[:, 20:]
    torch.testing.assert_close(out.spread[0, :, 20:], differing, atol=1e-5, rtol=0)


def moving() -> Actor:
    """A box two metres wide, 8 to 12 m ahead, that has moved 3 m to the right from frame 0 to 1 and is gone at 2."""
    boxes = np.stack([at(0.0, 10.0), at(3.0, 10.0)])
    return Actor("a", "car", (4.0, 4.0, 4.0), np.array([0, 1]), boxes, NO_POINTS)


def test_points_on_an_actor_are_looked_up_where_it_is():
    actor = moving()
    surface = plane(9.0, actors=(actor,))
    on = surface.actor == 0
    assert on[12, 20] and not on[12, 0] and not on[12, 39]
    color, seen = sample_source(surface, source(at(), 1), (actor,), 0)
    image = source(at(), 1).image
    assert seen[12, 20]
    torch.testing.assert_close(color[:, 12, 20], image[:, 12, 30], atol=1e-4, rtol=0)  # 30 · 3 / 9 = 10 px to the right
    torch.testing.assert_close(color[:, 12, 2], image[:, 12, 2], atol=1e-4, rtol=0)
    gone = sample_source(surface, source(at(), 2), (actor,), 0)[1]
    assert not gone[on].any() and gone[~on].all()


def test_images_are_chosen_for_what_is_still_unseen():
    left, right = torch.zeros(HEIGHT, WIDTH), torch.zeros(HEIGHT, WIDTH)
    left[:, :20], right[:, 20:] = 1.0, 1.0  # what stands before them hides one half
    sources = [source(at(), 0, 0, left), source(at(), 1, 1, left), source(at(), 2, 2, right), source(at(), 3, 3)]
    found = select_sources(plane(10.0), sources, ("front", 0), (), 0)
    assert [s.frame for s in found] == [0, 2]  # the second of two that bring the same does not come
    assert [s.frame for s in select_sources(plane(10.0), sources, ("front", 3), (), 0)] == [3]
    assert [s.frame for s in select_sources(plane(10.0), sources, ("front", 0), (), 0, count=1)] == [0]


def test_faults_are_said():
    with pytest.raises(ValueError, match="none of the sources"):
        select_sources(plane(5.0), [source(at())], ("front", 7), (), 0)
    with pytest.raises(ValueError, match="at least one source"):
        warp(plane(5.0), [], (), 0)
