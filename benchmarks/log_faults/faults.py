"""Faults of logs, each in growing strength."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from benchmarks.log_faults.changed_log import Changes
from genre_tasks.log_checks.pose_conventions import reread_rotations
from genre_tasks.logs.types import Camera, CuboidTrack, DrivingLog, Float64, Lens, Sweep
from genre_tasks.scene.transforms import compose_se3, invert_se3


@dataclass(frozen=True)
class Fault:
    """A kind of fault.

    Attributes:
        name: what is wrong, in words.
        unit: of the strength.
        strengths: that are tried.
        change: makes the changes of a strength for a log.
    """

    name: str
    unit: str
    strengths: tuple[float, ...]
    change: Callable[[DrivingLog, float], Changes]


def _change_lens(change: Callable[[Lens], Lens]) -> Changes:
    def change_camera(camera: Camera) -> Camera:
        return replace(camera, lens=change(camera.lens))

    return Changes(camera=change_camera)


def _shift_principal_point(log: DrivingLog, percent: float) -> Changes:
    return _change_lens(lambda lens: replace(lens, cx_px=lens.cx_px + percent / 100 * lens.width_px))


def _scale_focal_length(log: DrivingLog, factor: float) -> Changes:
    return _change_lens(lambda lens: replace(lens, fx_px=factor * lens.fx_px, fy_px=factor * lens.fy_px))


def _resize_images(log: DrivingLog, factor: float) -> Changes:
    """The intrinsics stay those of the larger image."""

    def resize(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        size = (round(factor * pixels.shape[1]), round(factor * pixels.shape[0]))
        return np.asarray(Image.fromarray(pixels).resize(size, Image.Resampling.BOX))

    def change_size(lens: Lens) -> Lens:
        return replace(lens, width_px=round(factor * lens.width_px), height_px=round(factor * lens.height_px))

    return replace(_change_lens(change_size), image=_edit_pixels(resize))


def _distort(log: DrivingLog, k1: float) -> Changes:
    return _change_lens(lambda lens: replace(lens, distortion=(k1, 0.0, 0.0, 0.0, 0.0)))


def _edit_pixels(edit: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> Callable[[str, int, bytes], bytes]:
    def change(camera: str, frame: int, image: bytes) -> bytes:
        pixels = np.asarray(Image.open(io.BytesIO(image)).convert("RGB"))
        stream = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(edit(pixels))).save(stream, "PNG", compress_level=0)
        return stream.getvalue()

    return change


def _turn_camera(axis: str) -> Callable[[DrivingLog, float], Changes]:
    def change(log: DrivingLog, angle_deg: float) -> Changes:
        turn = compose_se3(_rotation(axis, angle_deg), np.zeros(3))
        return Changes(camera_pose=lambda camera, frame, pose: pose @ turn)

    return change


def _rotation(axis: str, angle_deg: float) -> Float64:
    from scipy.spatial.transform import Rotation

    matrix: Float64 = Rotation.from_euler(axis, angle_deg, degrees=True).as_matrix()
    return matrix


def _mirror_images(log: DrivingLog, strength: float) -> Changes:
    return Changes(image=_edit_pixels(lambda pixels: pixels[:, ::-1]))


def _turn_images(log: DrivingLog, strength: float) -> Changes:
    return Changes(image=_edit_pixels(lambda pixels: pixels[::-1, ::-1]))


def _swap_images(log: DrivingLog, strength: float) -> Changes:
    names = [camera.name for camera in log.cameras]
    sources = dict(zip(names, names[1:] + names[:1], strict=True))
    return Changes(image_source=lambda camera, frame: (sources[camera], frame))


def _delay_images(log: DrivingLog, frames: float) -> Changes:
    count = log.frame_count
    return Changes(image_source=lambda camera, frame: (camera, (frame + int(frames)) % count))


def _move_everything(shift: Callable[[int], Float64]) -> Changes:
    """Poses and points are shifted together, as where one wrong pose made them all."""

    def move(frame: int, pose: Float64) -> Float64:
        return compose_se3(pose[:3, :3], pose[:3, 3] + shift(frame))

    return Changes(
        lidar_pose=move,
        camera_pose=lambda camera, frame, pose: move(frame, pose),
        sweep=lambda frame, sweep: replace(sweep, points_world=sweep.points_world + shift(frame)),
    )


def _drive_fast(log: DrivingLog, metres_a_frame: float) -> Changes:
    return _move_everything(lambda frame: np.array([metres_a_frame * frame, 0.0, 0.0]))


def _jump(log: DrivingLog, distance_m: float) -> Changes:
    # To the side and back again, so that every chunk has a jump.
    return _move_everything(lambda frame: np.array([0.0, distance_m * (frame // 4 % 2), 0.0]))


def _offset_camera_clock(log: DrivingLog, offset_s: float) -> Changes:
    return Changes(camera_time=lambda frame, time_s: time_s + offset_s)


def _scale_times(log: DrivingLog, factor: float) -> Changes:
    start_s = log.frame_timestamp_s(0)

    def scale(frame: int, time_s: float) -> float:
        return start_s + factor * (time_s - start_s)

    return Changes(frame_time=scale, camera_time=scale)


def _change_boxes(change: Callable[[CuboidTrack, float], CuboidTrack]) -> Callable[[DrivingLog, float], Changes]:
    return lambda log, strength: Changes(tracks=lambda tracks: tuple(change(track, strength) for track in tracks))


def _scale_box(track: CuboidTrack, factor: float) -> CuboidTrack:
    length, width, height = track.size_m
    return replace(track, size_m=(factor * length, factor * width, factor * height))


def _turn_box(track: CuboidTrack, angle_deg: float) -> CuboidTrack:
    return replace(track, world_SE3_box=track.world_SE3_box @ compose_se3(_rotation("z", angle_deg), np.zeros(3)))


def _shift_box(track: CuboidTrack, height_m: float) -> CuboidTrack:
    poses = track.world_SE3_box.copy()
    poses[:, 2, 3] += height_m
    return replace(track, world_SE3_box=poses)


def _change_points(change: Callable[[Float64, Float64, float], Float64]) -> Callable[[DrivingLog, float], Changes]:
    """``change`` takes points [N, 3], the LiDAR's pose and the strength."""

    def make(log: DrivingLog, strength: float) -> Changes:
        def edit(frame: int, sweep: Sweep) -> Sweep:
            return replace(sweep, points_world=change(sweep.points_world, log.world_SE3_lidar(frame), strength))

        return Changes(sweep=edit)

    return make


def _apply(pose: Float64, points: Float64) -> Float64:
    moved: Float64 = points @ pose[:3, :3].T + pose[:3, 3]
    return moved


def _place_by_first_pose(log: DrivingLog, strength: float) -> Changes:
    def place(frame: int, sweep: Sweep) -> Sweep:
        move = log.world_SE3_lidar(0) @ invert_se3(log.world_SE3_lidar(frame))
        return replace(sweep, points_world=_apply(move, sweep.points_world))

    return Changes(sweep=place)


def _mirror_points(points: Float64, world_SE3_lidar: Float64, strength: float) -> Float64:
    return _apply(world_SE3_lidar, _apply(invert_se3(world_SE3_lidar), points) * np.array([1.0, -1.0, 1.0]))


def _turn_points(points: Float64, world_SE3_lidar: Float64, angle_deg: float) -> Float64:
    turned = world_SE3_lidar @ compose_se3(_rotation("z", angle_deg), np.zeros(3)) @ invert_se3(world_SE3_lidar)
    return _apply(turned, points)


def _turn_down(points: Float64, world_SE3_lidar: Float64, strength: float) -> Float64:
    return _apply(world_SE3_lidar, _apply(invert_se3(world_SE3_lidar), points) * np.array([1.0, -1.0, -1.0]))


def _round_points(points: Float64, world_SE3_lidar: Float64, origin_m: float) -> Float64:
    return (points + origin_m).astype(np.float32).astype(np.float64) - origin_m


def _shift_sweeps(log: DrivingLog, frames: float) -> Changes:
    count = log.frame_count
    return Changes(sweep_source=lambda frame: (frame + int(frames)) % count)


def _misread(name: str, with_points: bool) -> Callable[[DrivingLog, float], Changes]:
    """Poses of the LiDAR read as another convention; where ``with_points``, points are placed by them as well."""

    def make(log: DrivingLog, strength: float) -> Changes:
        poses = np.stack([log.world_SE3_lidar(frame) for frame in range(log.frame_count)])
        misread = next(reading.world_SE3_lidar for reading in reread_rotations(poses) if reading.name == name)

        def place(frame: int, sweep: Sweep) -> Sweep:
            move = misread[frame] @ invert_se3(poses[frame])
            return replace(sweep, points_world=_apply(move, sweep.points_world))

        if with_points:
            return Changes(sweep=place)
        return Changes(lidar_pose=lambda frame, pose: misread[frame])

    return make


_ONCE = (1.0,)
# What a file with x, y, z, w gives to a reader that expects w, x, y, z.
_ORDER = "quaternions whose w, x, y, z were taken for x, y, z, w"
_CONJUGATE = "conjugate quaternions"

FAULTS: tuple[Fault, ...] = (
    Fault("principal point shifted", "% of the width", (2, 5, 10, 20, 50), _shift_principal_point),
    Fault("focal length scaled", "factor", (0.5, 0.7, 0.9, 0.95, 1.05, 1.1, 1.3, 2), _scale_focal_length),
    Fault("images resized, intrinsics not", "factor", (0.9, 0.75, 0.5), _resize_images),
    Fault("distortion k1 added", "k1", (-0.3, -0.1, 0.1, 0.3, 1000), _distort),
    Fault("camera turned sideways", "°", (0.5, 1, 2, 5, 10), _turn_camera("y")),
    Fault("camera turned down", "°", (1, 2, 5, 10), _turn_camera("x")),
    Fault("camera rolled", "°", (2, 5, 10), _turn_camera("z")),
    Fault("images swapped between cameras", "", _ONCE, _swap_images),
    Fault("images mirrored", "", _ONCE, _mirror_images),
    Fault("images turned by 180°", "", _ONCE, _turn_images),
    Fault("images of later frames", "frames", (1, 2, 5), _delay_images),
    Fault("vehicle moved on every frame", "m", (1, 5, 10, 60), _drive_fast),
    Fault("path jumps", "m", (0.1, 0.5, 2), _jump),
    Fault("camera clock shifted", "s", (0.05, 0.2, 1, 18), _offset_camera_clock),
    Fault("time scaled", "factor", (0.001, 0.1, 10, 1000), _scale_times),
    Fault("boxes scaled", "factor", (0.3048, 0.7, 1.4, 3.28, 100), _change_boxes(_scale_box)),
    Fault("boxes turned", "°", (10, 45, 90), _change_boxes(_turn_box)),
    Fault("boxes raised", "m", (0.5, 1, 3), _change_boxes(_shift_box)),
    Fault("points in LiDAR coordinates", "", _ONCE, _change_points(lambda p, pose, _: _apply(invert_se3(pose), p))),
    Fault("LiDAR pose applied twice", "", _ONCE, _change_points(lambda p, pose, _: _apply(pose, p))),
    Fault("all sweeps placed by the first pose", "", _ONCE, _place_by_first_pose),
    Fault("points scaled", "factor", (0.001, 0.3048, 3.28, 1000), _change_points(lambda p, _, s: s * p)),
    Fault("points mirrored left to right", "", _ONCE, _change_points(_mirror_points)),
    Fault("points upside down", "", _ONCE, _change_points(_turn_down)),
    Fault("points as float32", "m from the origin", (1e4, 1e5, 5e5, 4e6), _change_points(_round_points)),
    Fault("points turned about the LiDAR", "°", (1, 2, 5), _change_points(_turn_points)),
    Fault("sweeps of later frames", "frames", (1, 2, 5), _shift_sweeps),
    Fault("LiDAR poses: quaternions out of order", "", _ONCE, _misread(_ORDER, with_points=False)),
    Fault("LiDAR poses: quaternions conjugate", "", _ONCE, _misread(_CONJUGATE, with_points=False)),
    Fault("LiDAR poses: inverse", "", _ONCE, _misread("inverse poses", with_points=False)),
    Fault("points placed by quaternions out of order", "", _ONCE, _misread(_ORDER, with_points=True)),
    Fault("points placed by conjugate quaternions", "", _ONCE, _misread(_CONJUGATE, with_points=True)),
)
"""In the order in which the table has them."""
