"""What is written of a repaired pose: colour, opacity and depth are those of the repair."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from flows.simulation.outputs import write_depth
from flows.simulation.repair import FnetRepair
from genre_tasks.rollout.fix_rollout import FixedRolloutImages
from genre_tasks.rollout.rig import estimate_rig
from storage.codecs.exr import read_channels
from tests.rollout.small_rollout import images_at, recorded, without_car


def test_the_depth_of_filled_pixels_is_written(tmp_path: Path) -> None:
    images = images_at(without_car(), 2.0)[0]
    filled = torch.zeros_like(images.alpha, dtype=torch.bool)
    filled[0, 20:30, 20:40] = True
    depth = torch.where(filled, torch.full_like(images.depth, 7.0), images.depth)
    fixed = FixedRolloutImages(images.color, filled, images.alpha.masked_fill(filled, 1.0), depth)
    rig = estimate_rig([recorded().chunk_scene.chunk])
    repaired = FnetRepair(lambda _: fixed, tmp_path, rig)(images)
    assert (repaired.alpha[filled] == 1).all()
    write_depth(tmp_path / "depth.exr", repaired, 0)
    written = read_channels(tmp_path / "depth.exr", {"Z": np.float32}, depth.shape[1:])["Z"]
    assert np.array_equal(written, depth[0].numpy())
