"""Messages of NeuroNCAP's renderer protocol: JSON over HTTP, with times in microseconds."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError

from flows.simulators.image_request import ActorDescription, ActorPose
from flows.simulators.request_checks import MAX_ACTORS, check_pose
from genre_tasks.errors import InputError
from genre_tasks.lidar_simulation.ego_motion import interpolate_poses
from genre_tasks.logs.types import Float64

MICROSECONDS = 1e6
MAX_POSES = 200_000
"""Poses of all trajectories of one message: what ``/get_actors`` answers for a long log may be sent back."""

_Text = Annotated[str, Field(max_length=200)]
_Row = Annotated[list[FiniteFloat], Field(min_length=4, max_length=4)]
_Pose = Annotated[list[_Row], Field(min_length=4, max_length=4)]
# Doubles hold whole numbers up to here; microseconds reach into the 23rd century.
_Time = Annotated[int, Field(ge=0, le=2**53)]


class TrajectoryMessage(BaseModel):
    """An actor through time; keys that are not listed here are ignored, as other renderers do."""

    model_config = ConfigDict(extra="ignore")

    uuid: _Text
    poses: Annotated[list[_Pose], Field(max_length=MAX_POSES)]
    timestamps: Annotated[list[_Time], Field(max_length=MAX_POSES)]
    dims: Annotated[list[FiniteFloat], Field(min_length=3, max_length=3)]


class ImageMessage(BaseModel):
    """A request for an image. The protocol's own default of the format is ``raw``."""

    model_config = ConfigDict(extra="ignore")

    pose: _Pose
    timestamp: _Time
    camera_name: _Text
    image_format: Literal["png", "jpg", "jpeg", "raw"] = "raw"


_TRAJECTORIES = TypeAdapter(Annotated[list[TrajectoryMessage], Field(max_length=MAX_ACTORS)])
_IMAGE = TypeAdapter(ImageMessage)


@dataclass(frozen=True)
class Trajectory:
    """Where a simulator lets an actor drive.

    Attributes:
        track_id: the log's id, or a readable name in what a client sends.
        times_us: [T] microseconds, rising.
        world_SE3_box: [T, 4, 4] at these times.
        width_length_height_m: as stated; boxes keep the size of their Gaussians.
    """

    track_id: str
    times_us: tuple[int, ...]
    world_SE3_box: Float64
    width_length_height_m: tuple[float, ...]

    def pose_at(self, time_us: int) -> ActorPose | None:
        """Gives where the actor is.

        Args:
            time_us: microseconds.

        Returns:
            The pose; ``None`` before the first and after the last time of the trajectory.
        """
        if not self.times_us or not self.times_us[0] <= time_us <= self.times_us[-1]:
            return None
        # Whole microseconds since the first one: seconds since 1970 leave few digits for fractions.
        moments = np.array([time - self.times_us[0] for time in self.times_us], np.float64)
        asked = np.array([time_us - self.times_us[0]], np.float64)
        pose = interpolate_poses(self.world_SE3_box, moments, asked)[0]
        return ActorPose(self.track_id, pose, pose)


def find_unchanged(trajectories: Sequence[Trajectory], others: Sequence[Trajectory]) -> tuple[str, ...]:
    """Finds the actors that drive in the same way, in any order.

    Args:
        trajectories: of some actors, by the log's ids.
        others: of the same ones, or of others; by the log's ids, too.

    Returns:
        Track ids, in the order of ``trajectories``.
    """
    by_id = {other.track_id: other for other in others}
    return tuple(
        trajectory.track_id
        for trajectory in trajectories
        if trajectory.track_id in by_id
        and trajectory.times_us == by_id[trajectory.track_id].times_us
        and np.array_equal(trajectory.world_SE3_box, by_id[trajectory.track_id].world_SE3_box)
    )


def parse_image(body: bytes) -> ImageMessage:
    """Reads a request for an image.

    Args:
        body: JSON.

    Raises:
        InputError: it is no such message.

    >>> parse_image(b"{}")
    Traceback (most recent call last):
    genre_tasks.errors.InputError: pose: Field required; timestamp: Field required; ...
    """
    try:
        return _IMAGE.validate_json(body)
    except ValidationError as error:
        raise _translate(error) from error


def parse_trajectories(body: bytes) -> tuple[Trajectory, ...]:
    """Reads the trajectories of all actors.

    Args:
        body: JSON.

    Raises:
        InputError: it is no such message, or the poses are no poses.

    >>> parse_trajectories(b"[]")
    ()
    """
    try:
        messages = _TRAJECTORIES.validate_json(body)
    except ValidationError as error:
        raise _translate(error) from error
    count = sum(len(message.poses) for message in messages)
    if count > MAX_POSES:
        raise InputError(f"{count} poses in one message are too many", remedy=f"Send at most {MAX_POSES}.")
    return tuple(_read_trajectory(message) for message in messages)


def describe_recorded(actors: Sequence[ActorDescription], frame_s: float) -> tuple[Trajectory, ...]:
    """Writes the recorded actors as trajectories.

    A recorded actor is in the images of all cameras of its frames, and cameras fire up to half a frame before or after
    the mean time of a frame. So a trajectory begins half a frame before its first frame and ends half a frame after
    its last one.

    Args:
        actors: of a run.
        frame_s: seconds of a log frame.

    Returns:
        A trajectory for each actor, in the same order.
    """
    return tuple(_describe_actor(actor, frame_s) for actor in actors)


def write_trajectories(trajectories: Sequence[Trajectory]) -> list[dict[str, object]]:
    """Writes trajectories as JSON values.

    Args:
        trajectories: of actors.
    """
    return [
        {
            "uuid": trajectory.track_id,
            "poses": trajectory.world_SE3_box.tolist(),
            "timestamps": list(trajectory.times_us),
            "dims": list(trajectory.width_length_height_m),
        }
        for trajectory in trajectories
    ]


def _describe_actor(actor: ActorDescription, frame_s: float) -> Trajectory:
    length, width, height = actor.size_m
    times_us = tuple(round(float(time_s) * MICROSECONDS) for time_s in actor.times_s)
    poses = actor.world_SE3_box
    if times_us:
        half_us = round(frame_s / 2 * MICROSECONDS)
        # The protocol has no times before 0, where the clocks of some logs start.
        before_us = (max(0, times_us[0] - half_us),) if times_us[0] > 0 else ()
        after_us = (times_us[-1] + half_us,)
        moments = np.array([time - times_us[0] for time in times_us], np.float64)
        asked = np.array([time - times_us[0] for time in (*before_us, *after_us)], np.float64)
        ends = interpolate_poses(poses, moments, asked)
        poses = np.concatenate([ends[: len(before_us)], poses, ends[len(before_us) :]])
        times_us = (*before_us, *times_us, *after_us)
    return Trajectory(actor.track_id, times_us, poses, (width, length, height))


def _read_trajectory(message: TrajectoryMessage) -> Trajectory:
    name = repr(message.uuid)
    if len(message.poses) != len(message.timestamps):
        raise InputError(
            f"actor {name} has {len(message.poses)} poses and {len(message.timestamps)} timestamps",
            remedy="Send one timestamp for each pose.",
        )
    times = message.timestamps
    if any(later <= earlier for earlier, later in itertools.pairwise(times)):
        raise InputError(f"the timestamps of actor {name} do not rise", remedy="Send them in order, each once.")
    poses = [check_pose(np.array(pose, np.float64), f"actor {name}") for pose in message.poses]
    stacked = np.stack(poses) if poses else np.zeros((0, 4, 4))
    return Trajectory(message.uuid, tuple(times), stacked, tuple(message.dims))


def _translate(error: ValidationError) -> InputError:
    # Without the input itself: it may be long, or not finite, which JSON cannot carry back.
    problems = [
        f"{'.'.join(str(part) for part in entry['loc']) or 'the message'}: {entry['msg']}"
        for entry in error.errors(include_url=False, include_input=False, include_context=False)[:3]
    ]
    return InputError("; ".join(problems)[:600], remedy="See the guide on simulators for the protocol's messages.")
