"""Poses of a rig's cameras and of the vehicle at all frames, also where an image is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from genre_tasks.logs.posed_images.frame_grouping import FrameGroups
from genre_tasks.logs.posed_images.world_axes import choose_reference, place_vehicle
from genre_tasks.logs.types import Float64


@dataclass(frozen=True)
class RigPoses:
    """Poses in the world: metres, z up.

    Attributes:
        world_SE3_camera: by camera [F, 4, 4].
        world_SE3_ego: [F, 4, 4] at the camera that looks ahead most, x along the motion.
    """

    world_SE3_camera: Mapping[str, Float64]
    world_SE3_ego: Float64


def fill_rig_poses(groups: FrameGroups, world_R_source: Float64, scale: float) -> RigPoses:
    """Takes all poses to the world, and places cameras without an image by the rig.

    Args:
        groups: images by frame and camera.
        world_R_source: [3, 3].
        scale: metres a unit.

    Returns:
        The poses.
    """
    count = len(groups.frames)
    known = {name: np.array([name in frame for frame in groups.frames]) for name in groups.cameras}
    poses = {name: np.tile(np.eye(4), (count, 1, 1)) for name in groups.cameras}
    for index, frame in enumerate(groups.frames):
        for name, image in frame.items():
            poses[name][index, :3, :3] = world_R_source @ image.source_SE3_camera[:3, :3]
            poses[name][index, :3, 3] = scale * (world_R_source @ image.source_SE3_camera[:3, 3])
    # The camera with most images is the rig's origin: every other one is placed by it.
    anchor = max(groups.cameras, key=lambda name: int(known[name].sum()))
    for index in np.flatnonzero(~known[anchor]).tolist():
        other = next(iter(groups.frames[index]))
        poses[anchor][index] = poses[other][index] @ _find_mount(poses, known, known, (other, anchor), index)
    # The anchor has a pose at every frame now.
    posed = known | {anchor: np.ones(count, bool)}
    for name in groups.cameras:
        for index in np.flatnonzero(~known[name]).tolist():
            if name != anchor:
                mount = _find_mount(poses, known, posed, (anchor, name), index)
                poses[name][index] = poses[anchor][index] @ mount
    ordered = [poses[name] for name in groups.cameras]
    motion = ordered[0][-1, :3, 3] - ordered[0][0, :3, 3]
    reference = ordered[choose_reference(ordered, motion)]
    return RigPoses(poses, place_vehicle(reference[:, :3, 3], reference[:, :3, 2].mean(0)))


def _find_mount(
    poses: Mapping[str, Float64],
    known: Mapping[str, np.ndarray],
    posed: Mapping[str, np.ndarray],
    pair: tuple[str, str],
    index: int,
) -> Float64:
    """first_SE3_second [4, 4] at the frame nearest to ``index`` that has images of both."""
    first, second = pair
    frames = np.flatnonzero(posed[first])
    numbers = np.arange(len(known[first]))
    # Two cameras that share no frame: where the second is when its image is nearest in time, and the first between its
    # own images of before and after.
    candidates = (
        known[first] & known[second],
        known[second] & (frames[0] < numbers) & (numbers < frames[-1]),
        known[second],
    )
    of_second = _find_nearest(next(choice for choice in candidates if choice.any()), index)
    pose = _interpolate_pose(poses[first], frames, of_second)
    rotation = pose[:3, :3].T
    mount = np.eye(4)
    mount[:3, :3] = rotation @ poses[second][of_second][:3, :3]
    mount[:3, 3] = rotation @ (poses[second][of_second][:3, 3] - pose[:3, 3])
    return mount


def _interpolate_pose(poses: Float64, frames: np.ndarray, index: int) -> Float64:
    """[4, 4] between the frames before and after ``index`` that have a pose; that of the nearest at the ends."""
    from scipy.spatial.transform import Rotation, Slerp

    after = int(np.searchsorted(frames, index))
    if after == len(frames) or after == 0 or frames[after] == index:
        return poses[frames[min(after, len(frames) - 1)]]
    ends = frames[after - 1 : after + 1]
    between = np.eye(4)
    between[:3, :3] = Slerp(ends, Rotation.from_matrix(poses[ends, :3, :3]))(index).as_matrix()
    between[:3, 3] = [np.interp(index, ends, poses[ends, axis, 3]) for axis in range(3)]
    return between


def _find_nearest(frames: np.ndarray, index: int) -> int:
    """The frame nearest to ``index`` of those that are true."""
    candidates = np.flatnonzero(frames)
    return int(candidates[np.abs(candidates - index).argmin()])
