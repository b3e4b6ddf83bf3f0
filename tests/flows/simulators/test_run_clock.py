"""Times and frames where cameras fire at moments of their own, and the rig as it is at one moment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from flows.simulation.run_scenes import RunScenes
from flows.simulators.run_clock import read_clock
from flows.simulators.run_facts import read_run_facts
from genre_tasks.errors import InputError
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene_edits.chunk_scene import ChunkScene

LATE_S = 0.04


@dataclass
class Scenes:
    """Scenes with other chunks."""

    recorded: RunScenes
    chunks: dict[int, Chunk]

    @property
    def chunk_numbers(self) -> list[int]:
        return list(self.chunks)

    def load(self, number: int) -> ChunkScene:
        return replace(self.recorded.load(number), chunk=self.chunks[number])


@pytest.fixture(scope="module")
def scenes(served: tuple[str, str]) -> Scenes:
    """The run as if its left camera fired late, while the vehicle drives on."""
    recorded = RunScenes(*served)
    chunks = {}
    for number in recorded.chunk_numbers:
        chunk = recorded.load(number).chunk
        step = (chunk.chunk_SE3_ego[-1] - chunk.chunk_SE3_ego[0]) / (len(chunk.frames) - 1)
        views = []
        for view in chunk.views:
            if view.camera == "front_left_camera":
                pose = view.chunk_SE3_camera.copy()
                pose[:3, 3] += step[:3, 3] * LATE_S / 0.1
                view = replace(view, timestamp_s=view.timestamp_s + LATE_S, chunk_SE3_camera=pose)
            views.append(view)
        chunks[number] = replace(chunk, views=tuple(views))
    return Scenes(recorded, chunks)


def test_each_camera_has_a_clock(scenes: Scenes) -> None:
    clock = read_clock(list(scenes.chunks.values()))
    first_s = clock.camera_times_s["front_camera"][0]
    assert clock.find_frame(first_s + 0.3, "front_camera") == pytest.approx(3, abs=1e-4)
    assert clock.find_frame(first_s + 0.3 + LATE_S, "front_left_camera") == pytest.approx(3, abs=1e-4)
    assert clock.find_frame(first_s + 0.3 + LATE_S / 2) == pytest.approx(3, abs=1e-4)
    assert clock.find_time(3) == pytest.approx(first_s + 0.3 + LATE_S / 2, abs=1e-5)
    assert clock.range_s == pytest.approx((first_s, first_s + 1.1 + LATE_S), abs=1e-5)
    # No farther out than the nearest frame reaches.
    assert clock.find_frame(first_s - 5.0) == -0.49 and clock.find_frame(first_s + 99.0) == 11.49


def test_the_rig_is_that_of_one_moment(scenes: Scenes, served: tuple[str, str]) -> None:
    late = read_run_facts(scenes)
    punctual = read_run_facts(RunScenes(*served))
    lefts = [facts.cameras["front_left_camera"].rig_SE3_camera[:3, 3] for facts in (late, punctual)]
    fronts = [facts.cameras["front_camera"].rig_SE3_camera[:3, 3] for facts in (late, punctual)]
    # Frames count from the mean of both cameras, so both move alike, and their distance stays.
    assert np.allclose(lefts[0] - fronts[0], lefts[1] - fronts[1], atol=2e-3)
    assert np.linalg.norm(lefts[0] - lefts[1]) > 0.05


def test_missing_images_and_times_that_do_not_rise(scenes: Scenes) -> None:
    chunk = scenes.chunks[0]
    clock = read_clock([chunk])
    thinned = replace(chunk, views=tuple(v for v in chunk.views if v.frame != 2 or v.camera != "front_camera"))
    assert np.allclose(read_clock([thinned]).times_s, clock.times_s, atol=1e-5)
    cut = replace(chunk, views=tuple(v for v in chunk.views if v.frame < 4 or v.camera != "front_camera"))
    assert np.allclose(read_clock([cut]).times_s, clock.times_s, atol=1e-5)
    stuck = replace(chunk, views=tuple(replace(v, timestamp_s=7.0) for v in chunk.views))
    with pytest.raises(InputError, match="do not rise"):
        read_clock([stuck])
    with pytest.raises(InputError, match="no images"):
        read_clock([replace(chunk, views=())])
