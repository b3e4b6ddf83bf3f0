"""The counts of a render are those of its images."""

from __future__ import annotations

from dataclasses import replace

import torch

from benchmarks.raster.work_count import Work, count_work
from genre_tasks.render import Cameras
from genre_tasks.scene.gaussians import Splats


def test_one_gaussian_of_known_size():
    camera = Cameras(torch.eye(4)[None], torch.full((1, 2), 50.0), torch.full((1, 2), 16.0), 32, 32)
    splats = Splats(
        torch.tensor([[0.0, 0.0, 5.0]]),
        torch.full((1, 3), 0.2),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([0.8]),
        torch.ones(1, 3),
    )
    work = count_work(splats, camera)
    offset = torch.arange(32.0) - 15.5
    alpha = 0.8 * torch.exp(-(offset[:, None] ** 2 + offset[None] ** 2) / (2 * ((50 * 0.2 / 5) ** 2 + 0.3)))
    touched = alpha >= 1 / 255
    blocks = touched.reshape(8, 4, 8, 4).any(dim=3).any(dim=1).sum()
    assert work == Work(1, 4, 16 * int(blocks), int(touched.sum()))


def test_nothing_counts_nothing(scene):
    splats, cameras = scene(50)
    assert count_work(replace(splats, opacities=splats.opacities * 0), cameras) == Work(0, 0, 0, 0)


def test_lanes_hold_the_contributions_and_views_add_up(scene):
    splats, cameras = scene(3000, 160, 90, views=2)
    both = count_work(splats, cameras)
    names = ("camera_SE3_chunk", "focal_px", "center_px")
    one, other = (
        count_work(splats, replace(cameras, **{n: getattr(cameras, n)[v : v + 1] for n in names})) for v in (0, 1)
    )
    assert both == Work(*(a + b for a, b in zip(vars(one).values(), vars(other).values(), strict=True)))
    assert 0.3 * both.lanes < both.contributions < both.lanes
