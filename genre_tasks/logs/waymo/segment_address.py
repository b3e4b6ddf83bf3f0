"""Addresses of segments: ``waymo:PATH/SEGMENT``, where PATH has a folder for each component."""

from __future__ import annotations

import fnmatch
from pathlib import Path
from typing import Any

from genre_tasks.errors import InputError
from genre_tasks.user_paths import expand_user_path

# Folder → prefix of its columns.
COMPONENTS = {
    "vehicle_pose": "VehiclePoseComponent",
    "camera_calibration": "CameraCalibrationComponent",
    "camera_image": "CameraImageComponent",
    "lidar": "LiDARComponent",
    "lidar_calibration": "LiDARCalibrationComponent",
    "lidar_pose": "LiDARPoseComponent",
    "lidar_box": "LiDARBoxComponent",
}
REQUIRED = ("vehicle_pose", "camera_calibration", "camera_image")

_SUFFIX = ".parquet"
_REMEDY = "Give the folder of the components and a segment, as in waymo:PATH/10023947602400723454_1120_000_1140_000."
_MAX_LISTED = 5


def find_component_files(rest: str) -> tuple[str, dict[str, Path]]:
    """Finds the files of a segment.

    Args:
        rest: what follows ``waymo:``; ``.parquet`` behind the segment is allowed.

    Returns:
        The segment, and component → file, of those that there are.

    Raises:
        InputError: there is no such segment, or it lacks a component that is needed.
    """
    where: dict[str, Any] = {"log": f"waymo:{rest}"}
    path = expand_user_path(rest)
    root = path.parent
    segment = path.name.removesuffix(_SUFFIX)
    files = {name: root / name / f"{segment}{_SUFFIX}" for name in COMPONENTS}
    found = {name: file for name, file in files.items() if file.is_file()}
    missing = [name for name in REQUIRED if name not in found]
    if rest and segment and not missing:
        return segment, found
    if rest and found:
        problem = f"the segment lacks {', '.join(missing)}"
        raise InputError(problem, remedy="Download these components too.", file=files[missing[0]], **where)
    # A user may name the folder above, or that of a component.
    for folder in (path, root, root.parent):
        segments = list_segment_names(folder) if rest else []
        if segments:
            more = ", …" if len(segments) > _MAX_LISTED else ""
            remedy = f"{_REMEDY} Segments in {folder}: {', '.join(segments[:_MAX_LISTED])}{more}."
            raise InputError("there is no such segment", remedy=remedy, file=path, **where)
    if rest and any(next(folder.glob("*.tfrecord"), None) for folder in (path, root) if folder.is_dir()):
        problem = "these are files of version 1 of the dataset"
        raise InputError(problem, remedy="Download version 2, which is Parquet.", file=root, **where)
    problem = f"no segments of Waymo's version 2 here: no folders {', '.join(REQUIRED)}"
    raise InputError(problem, remedy=_REMEDY, file=root, **where)


def list_segment_names(root: Path) -> list[str]:
    """Lists the segments in a folder of components, sorted.

    Args:
        root: that holds the folders of the components.
    """
    return sorted(path.stem for path in (root / REQUIRED[0]).glob(f"*{_SUFFIX}"))


def list_segments(rest: str) -> list[str]:
    """Lists the segments that a pattern stands for.

    Args:
        rest: what follows ``waymo:``, with stars in the segment's name.

    Returns:
        What follows ``waymo:`` for each of them, sorted by name.
    """
    path = expand_user_path(rest)
    # Only a star stands for other characters, as in names of folders.
    pattern = path.name.replace("[", "[[]").replace("?", "[?]")
    names = list_segment_names(path.parent)
    return [str(path.parent / name) for name in names if fnmatch.fnmatchcase(name, pattern)]
