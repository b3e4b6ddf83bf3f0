"""The rig of a rollout, as the recorded views tell it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from genre_tasks.logs.types import RollingShutter
from genre_tasks.rollout.rig import estimate_rig
from genre_tasks.scene.chunk import Chunk
from tests.rollout.small_rollout import recorded


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_camera_has_the_shutter_of_the_chunk_that_models_it(order: tuple[int, int]) -> None:
    off = recorded().chunk_scene.chunk
    on = _with_readout(off, 0.03)
    rig = estimate_rig([(off, on)[k] for k in order])
    assert {camera.readout_s for camera in rig} == {0.03}
    assert {camera.readout_s for camera in estimate_rig([off])} == {0.0}


def test_a_camera_has_the_distortion_of_the_chunk_that_models_it() -> None:
    straight = recorded().chunk_scene.chunk
    bent = (-0.1, 0.0, 0.0, 0.0, 0.0)
    views = tuple(replace(view, lens=replace(view.lens, distortion=bent)) for view in straight.views)
    rig = estimate_rig([straight, replace(straight, views=views)])
    assert {camera.lens.distortion for camera in rig} == {bent}


def _with_readout(chunk: Chunk, readout_s: float) -> Chunk:
    shutter = RollingShutter(readout_s, velocity_m_s=(0.0, 0.0, 10.0), turn_rad_s=(0.0, 0.0, 0.0))
    return replace(chunk, views=tuple(replace(view, shutter=shutter) for view in chunk.views))
