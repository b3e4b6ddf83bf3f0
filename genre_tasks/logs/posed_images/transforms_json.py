"""Reads ``transforms.json`` of nerfstudio and instant-ngp: OpenGL camera axes, intrinsics global or of each frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.logs.lens_validity import refuse_unread_distortion
from genre_tasks.logs.posed_images.posed_image import MAX_IMAGES, PosedImage, make_lens, make_pose
from genre_tasks.logs.types import Float64, Lens

_REMEDY = "Give a transforms.json of nerfstudio or instant-ngp, or a COLMAP model."
_MAX_BYTES = 1 << 28
# What each of them has of OPENCV's terms is written out in the file, so that one formula serves all.
_CAMERA_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")
# The order of its ``get_distortion_params``; its reader prefers the list to separate names.
_NERFSTUDIO_LIST = "distortion_params"
_NERFSTUDIO_ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")
# OpenGL looks along −z with y up; this project along z with y down.
_OPENGL_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def read_transforms(path: Path) -> tuple[PosedImage, ...]:
    """Reads all frames of a ``transforms.json``.

    A frame may name its camera by ``camera`` or ``camera_label``, and its time in seconds by ``time`` or
    ``timestamp``.

    Args:
        path: of the file.

    Returns:
        The images, in the order of the file.

    Raises:
        InputError: the file is unreadable or too large, has no frames, another camera model, or an unsound number.
    """
    size = path.stat().st_size if path.is_file() else 0
    if size > _MAX_BYTES:
        raise InputError(f"the file of poses has {size >> 20} MiB", remedy=_REMEDY, file=path)
    values = read_json_object(path, "file of poses", _REMEDY)
    frames = values.get("frames")
    if not isinstance(frames, list) or not frames or len(frames) > MAX_IMAGES:
        raise InputError("the file of poses has no list of frames", remedy=_REMEDY, file=path)
    return tuple(_read_frame(values, frame, index, path) for index, frame in enumerate(frames))


def _read_frame(shared: Mapping[str, Any], frame: Any, index: int, path: Path) -> PosedImage:
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise InputError(f"frame {index} has no file_path", remedy=_REMEDY, file=path)
    name = frame["file_path"].replace("\\", "/").removeprefix("./")
    label = frame.get("camera", frame.get("camera_label"))
    return PosedImage(
        name=name,
        source_SE3_camera=make_pose(_read_matrix(frame, name, path) @ _OPENGL_FLIP, name, path),
        lens=_read_lens({**shared, **frame}, path),
        camera=None if label is None else str(label),
        time_s=_read_time(frame, name, path),
    )


def _read_matrix(frame: Mapping[str, Any], name: str, path: Path) -> Float64:
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(f"{name} has no transform_matrix of 4 × 4 numbers", remedy=_REMEDY, file=path)
    return np.vstack([matrix[:3], [0.0, 0.0, 0.0, 1.0]])


def _read_lens(values: Mapping[str, Any], path: Path) -> Lens:
    model = str(values.get("camera_model", "OPENCV"))
    if model not in _CAMERA_MODELS or values.get("is_fisheye"):
        name = "a fisheye" if values.get("is_fisheye") else model
        raise InputError(
            f"the camera model {name} is not supported",
            remedy="Undistort the images to PINHOLE or OPENCV, as `colmap image_undistorter` does.",
            file=path,
        )
    width = _read_number(values, "w", path)
    height = _read_number(values, "h", path)
    focal_x = values.get("fl_x")
    if focal_x is None and "camera_angle_x" in values:
        angle = _read_number(values, "camera_angle_x", path)
        focal_x = width / 2 / math.tan(angle / 2) if 0 < angle < math.pi else math.nan
        values = {**values, "fl_x": focal_x}
    values = {"fl_y": focal_x, "cx": width / 2, "cy": height / 2, **values}
    focal_px = (_read_number(values, "fl_x", path), _read_number(values, "fl_y", path))
    center_px = (_read_number(values, "cx", path), _read_number(values, "cy", path))
    return make_lens(focal_px, center_px, (round(width), round(height)), _read_distortion(values, path), path)


def _read_distortion(values: Mapping[str, Any], path: Path) -> tuple[float, ...]:
    """k1, k2, p1, p2, k3."""
    remedy = f"Write them as {', '.join(_COEFFICIENTS)}."
    refuse_unread_distortion(values, (*_NERFSTUDIO_ORDER, _NERFSTUDIO_LIST), remedy, file=path)
    # Of two statements, nerfstudio takes the list.
    values = {**values, **_read_distortion_list(values, path)}
    # A fourth radial term has another meaning in every model, and leaving it out would bend the image.
    if values.get("k4"):
        raise InputError("a lens with k4 is not supported", remedy="Undistort the images first.", file=path)
    return tuple(_read_number({key: 0.0, **values}, key, path) for key in _COEFFICIENTS)


def _read_distortion_list(values: Mapping[str, Any], path: Path) -> dict[str, float]:
    """The coefficients that nerfstudio's list states, by name; empty where there is none, or zeros alone."""
    stated = values.get(_NERFSTUDIO_LIST)
    if not stated or (isinstance(stated, list) and not any(stated)):
        return {}
    numbers = [_as_number(value) for value in stated] if isinstance(stated, list) else []
    coefficients = [number for number in numbers if number is not None]
    if len(numbers) != len(_NERFSTUDIO_ORDER) or len(coefficients) < len(numbers):
        order = ", ".join(_NERFSTUDIO_ORDER)
        problem = f"{_NERFSTUDIO_LIST} is no list of the six numbers {order}"
        raise InputError(problem, remedy="Write all six, or undistort the images first.", file=path)
    return dict(zip(_NERFSTUDIO_ORDER, coefficients, strict=True))


def _read_number(values: Mapping[str, Any], key: str, path: Path) -> float:
    number = _as_number(values.get(key))
    if number is None:
        raise InputError(f"the intrinsics lack a number for {key}", remedy=_REMEDY, file=path)
    return number


def _read_time(frame: Mapping[str, Any], name: str, path: Path) -> float | None:
    value = frame.get("time", frame.get("timestamp"))
    if value is None:
        return None
    number = _as_number(value)
    if number is None:
        raise InputError(f"the time of {name} is no number", remedy="Write seconds, or no time at all.", file=path)
    return number


def _as_number(value: object) -> float | None:
    """A finite number of JSON, or ``None``."""
    # A bool is an int of Python.
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        # Integers of JSON have any number of digits.
        return None
    return number if math.isfinite(number) else None
