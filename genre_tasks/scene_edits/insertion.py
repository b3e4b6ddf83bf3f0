"""The path of an inserted actor along the recorded path of the ego vehicle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frame_clock import FrameClock
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.scene.transforms import compose_se3
from genre_tasks.scene_edits.actor_library import LibraryActor
from genre_tasks.scene_edits.edits import Insert
from genre_tasks.scene_edits.run_survey import RunSurvey
from genre_tasks.scene_edits.trajectories import Trajectory, measure_speed

# An actor that faces nearer than this to the path's direction follows the path, or comes along it; others cross it.
_ALONG_COSINE = math.cos(math.radians(45))
_MIN_STEP_M = 0.05


def place_inserted(insert: Insert, actor: LibraryActor, recorded_clock: FrameClock, survey: RunSurvey) -> Trajectory:
    """Places an inserted actor on the recorded path.

    It starts ``ahead_m`` in front of the ego vehicle and drives in the direction that it faces: along the path, against
    it, or straight across it. Where the path ends it drives straight on.

    Args:
        insert: where, and how fast.
        actor: what is inserted.
        recorded_clock: of the run that the actor is from.
        survey: of the run that is edited.

    Returns:
        A pose on the ground for each log frame from ``start_s`` on.

    Raises:
        InputError: the run ends before ``start_s``.
    """
    frames = survey.clock.frames.astype(np.int64)
    times = survey.clock.times_s
    # Half a frame of tolerance, as times come from rounded timestamps.
    present = times >= insert.start_s - 0.5 * survey.clock.frame_s
    if not present.any():
        problem = f"an inserted actor would appear after {insert.start_s:g} s, and the run ends at {times[-1]:.1f} s"
        raise InputError(problem, remedy="Give an earlier start_s.")
    track = actor.track
    recorded = Trajectory(track.frames, track.world_SE3_box, track.frames.astype(np.float64))
    speed = measure_speed(recorded, recorded_clock) if insert.speed_m_s is None else insert.speed_m_s
    travelled = speed * (times[present] - times[present][0])
    line = _PathLine(survey.path)
    start = line.length_at(float(frames[present][0])) + insert.ahead_m
    turn = math.radians(insert.turn_deg)
    along = math.cos(turn)
    # A car that is turned by 180 degrees drives forward too: it is oncoming.
    progress = np.sign(along) * travelled if abs(along) >= _ALONG_COSINE else np.zeros(len(travelled))
    places, heading = line.at(start + progress, insert.left_m)
    yaw = heading + turn
    if abs(along) < _ALONG_COSINE:
        places = places + travelled[:, None] * np.stack([np.cos(yaw), np.sin(yaw)], 1)
    height, normal = survey.ground.measure(places)
    up = actor.clearance_m + track.size_m[2] / 2
    poses = compose_se3(_upright(yaw, normal), np.concatenate([places, height[:, None]], 1) + up * normal)
    # Its recorded shapes as time goes on: a pedestrian walks at the pace of the recording.
    first_s = recorded_clock.find_times(actor.shape_frames[:1])
    shapes = recorded_clock.find_frames(first_s + times[present] - times[present][0])
    shapes = np.minimum(shapes, actor.shape_frames[-1])
    return Trajectory(frames[present], poses, shapes)


def _upright(yaw: Float64, normal: Float64) -> Float64:
    # Rotations [F, 3, 3] with the heading `yaw` that stand on ground with the normals [F, 3].
    level = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    tilt = np.cross([0.0, 0.0, 1.0], normal)
    return np.asarray(Rotation.from_rotvec(tilt).as_matrix() @ level, np.float64)


def _find_distinct(places: Float64) -> NDArray[np.bool_]:
    # Which of the places [P, 2] are away from the last such place: a standing vehicle jitters, which is no way.
    found = np.zeros(len(places), bool)
    last = np.full(2, np.inf)
    for k, place in enumerate(places):
        if not np.linalg.norm(place - last) < _MIN_STEP_M:
            found[k] = True
            last = place
    return found


class _PathLine:
    # The recorded path as a line, by its length; straight on at both ends.

    def __init__(self, path: EgoPath) -> None:
        self._frames = path.frames
        places = path.world_SE3_ego[:, :2, 3]
        forward = path.world_SE3_ego[:, :2, 0]
        distinct = _find_distinct(places)
        steps = np.linalg.norm(np.diff(places[distinct], axis=0), axis=1)
        self._length = np.concatenate([[0.0], np.cumsum(steps)])
        self._length_of_frame = self._length[np.cumsum(distinct) - 1]
        self._places = places[distinct]
        self._yaw = np.unwrap(np.arctan2(forward[distinct, 1], forward[distinct, 0]))

    def length_at(self, frame: float) -> float:
        return float(np.interp(frame, self._frames, self._length_of_frame))

    def at(self, length: Float64, left_m: float) -> tuple[Float64, Float64]:
        # Places [F, 2] and headings [F].
        yaw = np.interp(length, self._length, self._yaw)
        inside = length.clip(self._length[0], self._length[-1])
        centre = np.stack([np.interp(inside, self._length, self._places[:, k]) for k in (0, 1)], 1)
        forward = np.stack([np.cos(yaw), np.sin(yaw)], 1)
        left = np.stack([-forward[:, 1], forward[:, 0]], 1)
        return centre + (length - inside)[:, None] * forward + left_m * left, yaw
