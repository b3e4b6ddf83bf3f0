"""Edits of a run whose recording paused: seconds count, and not frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from flows.paper_tables.rollout_figures import _ActorView, _edit_actor
from genre_tasks.config import PipelineConfig
from genre_tasks.ego_paths.frame_clock import FrameClock, measure_clock
from genre_tasks.scene_edits.chunk_scene import ChunkScene
from genre_tasks.scene_edits.edits import ActorChange, Insert, Retime, ScaleSpeed
from genre_tasks.scene_edits.run_survey import survey_run
from genre_tasks.scene_edits.trajectories import Trajectory, change_trajectory, measure_speed
from tests.fakes import yaw_pose
from tests.scene_edits.edited_runs import MadeRun, edit, find_node, world_poses

PAUSE_S = 2.0


class PausedRun:
    """The made run, but seconds pass between its chunks: frame 5 is at 0.5 s and frame 6 at 2.6 s."""

    def __init__(self) -> None:
        self._run = MadeRun()
        self.chunk_numbers: Sequence[int] = self._run.chunk_numbers

    def load(self, number: int) -> ChunkScene:
        """Chunk 1 is later than in the made run."""
        scene = self._run.load(number)
        views = tuple(replace(v, timestamp_s=v.timestamp_s + PAUSE_S * number) for v in scene.chunk.views)
        return replace(scene, chunk=replace(scene.chunk, views=views))


@pytest.fixture(scope="module")
def run() -> PausedRun:
    return PausedRun()


def test_a_delay_across_a_pause_is_as_long_as_asked_for(run: PausedRun) -> None:
    edited = edit(run, Retime(actor="a", delay_s=1.0))
    x = np.concatenate([world_poses(edited.load(number), "a")[:, 0, 3] for number in (0, 1)])
    recorded_x = np.concatenate([world_poses(run.load(number), "a")[:, 0, 3] for number in (0, 1)])
    times_s = np.array([0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 2.6, 2.7, 2.8, 2.9, 3.0, 3.1])
    # Before the path begins, the car comes at the 10 m/s of its first frames.
    asked_s = times_s - 1.0
    expected = np.interp(asked_s, times_s, recorded_x) + 10.0 * np.minimum(asked_s, 0)
    assert x == pytest.approx(expected, abs=0.05)


def test_a_delayed_actor_is_in_the_frames_of_its_new_times(run: PausedRun) -> None:
    # The pedestrian is in frames 8 to 11, from 2.8 s on: 2.3 s sooner it comes at 0.5 s, which is frame 5.
    edited = edit(run, Retime(actor="c", delay_s=-2.3))
    assert find_node(edited.load(0), "c").frames.tolist() == [5]
    assert find_node(edited.load(1), "c").frames.tolist() == [6, 7, 8, 9, 10, 11]


def test_shapes_follow_the_seconds_of_a_delay(run: PausedRun) -> None:
    survey = survey_run(run)
    track = survey.tracks["a"]
    path = Trajectory(track.frames, track.world_SE3_box, track.frames.astype(np.float64))
    delayed = change_trajectory(path, ActorChange(delay_s=Fraction("2.2")), survey.clock, survey.ground)
    # Frame 6 is at 2.6 s, and shows what was at 0.4 s.
    assert delayed.frames.tolist() == list(range(12))
    assert delayed.shape_frames[[5, 6, 7]].tolist() == [0.0, 4.0, 5.0]


def test_a_delayed_actor_stays_absent_in_long_gaps(run: PausedRun) -> None:
    clock = FrameClock(np.arange(60.0), 0.1 * np.arange(60))
    frames = np.concatenate([np.arange(10), np.arange(14, 20), np.arange(40, 50)])
    poses = np.stack([yaw_pose(0.0, (float(frame), 0.0, 0.0)) for frame in frames])
    path = Trajectory(frames, poses, frames.astype(np.float64))
    delayed = change_trajectory(path, ActorChange(delay_s=Fraction("0.2")), clock, survey_run(run).ground)
    # Of the gaps the one of four frames is bridged, as in the recording.
    assert delayed.frames.tolist() == [*range(22), *range(42, 52)]
    assert delayed.world_SE3_box[:, 0, 3] == pytest.approx(delayed.frames - 2.0, abs=1e-6)


def test_speeds_count_the_seconds_of_a_pause(run: PausedRun) -> None:
    survey = survey_run(run)
    track = survey.tracks["a"]
    path = Trajectory(track.frames, track.world_SE3_box, track.frames.astype(np.float64))
    assert measure_speed(path, survey.clock) == pytest.approx(11.0 / 3.1, rel=1e-6)
    # At a speed of 2 m/s, a taxi is 5.2 m on after 2.6 s.
    taxi = edit(run, Insert(actor="a", name="taxi", speed_m_s=2.0))
    gone = world_poses(taxi.load(1), "taxi")[0, 0, 3] - world_poses(taxi.load(0), "taxi")[0, 0, 3]
    assert gone == pytest.approx(5.2, abs=0.05)


def test_an_actor_at_half_its_speed_is_half_as_far(run: PausedRun) -> None:
    x = world_poses(edit(run, ScaleSpeed(actor="a", factor=0.5)).load(1), "a")[:, 0, 3]
    first_x = world_poses(run.load(0), "a")[0, 0, 3]
    assert x - first_x == pytest.approx(0.5 * np.arange(6, 12), abs=0.05)


def test_the_figure_of_edits_inserts_at_the_frame_that_it_shows(run: PausedRun) -> None:
    chunk = run.load(1).chunk
    shown = _ActorView(chunk, chunk.views[1], "a", area=1.0, left_of_ego=True)
    assert chunk.views[1].frame == 7
    scenes = _edit_actor(run, PipelineConfig(), shown, "car-1")["inserted again"]
    assert "inserted" not in {node.track_id for node in scenes.load(0).scene.actors}
    assert find_node(scenes.load(1), "inserted").frames.tolist() == [7, 8, 9, 10, 11]


def test_frames_that_chunks_share_count_once(run: PausedRun) -> None:
    chunk = run.load(0).chunk
    clock = measure_clock([chunk, chunk, run.load(1).chunk])
    assert clock.frames.tolist() == list(range(12))
    assert clock.times_s[[5, 6]] == pytest.approx([0.5, 2.6])
    assert clock.frame_s == pytest.approx(0.1)
    assert FrameClock(np.array([3.0]), np.array([0.0])).frame_s == 0.1
