"""KITTI's boxes: tracklets of raw recordings, and labels of the tracking benchmark."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.box_validity import StatedBox, find_bad_boxes, report_bad_boxes
from genre_tasks.logs.file_reading import read_file
from genre_tasks.logs.findings import Finding
from genre_tasks.logs.kitti.drive_files import parse_numbers, read_text
from genre_tasks.logs.labelled_boxes import LabelledBox
from genre_tasks.logs.types import Float64

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

# A file of hundreds of objects has a few megabytes.
_MAX_XML_BYTES = 1 << 27
_REMEDY = "Copy the labels of this drive again."
_NOT_LABELLED = "DontCare"
# Box axes in the camera's: the box's x forward, y left, z up; the camera's x right, y down, z forward.
_CAMERA_R_BOX = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True)
class _BoxRow:
    """A box as both files state it, unchecked.

    Attributes:
        stated: frame, object and place in the file.
        lower: [3] middle of the lower face.
        angles_rad: [K] turns, in the order of the file.
        size_m: length, width, height.
    """

    stated: StatedBox
    lower: Float64
    angles_rad: Float64
    size_m: tuple[float, float, float]


def read_tracklets(path: Path, frame_count: int, log: str) -> tuple[list[LabelledBox], tuple[Finding, ...]]:
    """Reads the tracklets of a raw recording, whose boxes are in the axes of the LiDAR.

    Args:
        path: ``tracklet_labels.xml``.
        frame_count: boxes of later frames are left out.
        log: URI of the log, for errors.

    Returns:
        The boxes, and ``invalid_box`` for each that cannot be used.

    Raises:
        InputError: the file is no XML of tracklets, is too large, or declares entities; all boxes are bad.
    """
    if path.stat().st_size > _MAX_XML_BYTES:
        raise InputError(f"the file has {path.stat().st_size} bytes", remedy=_REMEDY, file=path, log=log)
    data = read_file(path, log=log)
    # An entity may stand for gigabytes, or for another file. Boost, which wrote these, declares an empty type.
    if b"<!ENTITY" in data:
        raise InputError("the XML declares entities", remedy=_REMEDY, file=path, log=log)
    try:
        root = ElementTree.fromstring(data)  # noqa: S314 (without entities nothing can grow)
        rows = [row for number, item in enumerate(_find_items(root)) for row in _read_tracklet(item, number, path.name)]
    # The header of the file names its encoding, which may be none that there is.
    except (ElementTree.ParseError, LookupError, ValueError, OverflowError) as error:
        raise InputError(f"the tracklets cannot be read ({error})", remedy=_REMEDY, file=path, log=log) from error
    return _build_boxes(rows, _place_tracklet, frame_count, path, log)


def _find_items(root: Element) -> list[Element]:
    tracklets = root.find("tracklets")
    if tracklets is None:
        raise ValueError("there is no element tracklets")
    return tracklets.findall("item")


def _read_tracklet(item: Element, number: int, name: str) -> Iterator[_BoxRow]:
    height, width, length = (_number(item, side) for side in "hwl")
    # A tracklet has a pose for every frame from there on.
    first = int(_number(item, "first_frame"))
    label = item.findtext("objectType", "unknown")
    for index, pose in enumerate(item.findall("poses/item")):
        stated = StatedBox(first + index, str(number), label, f"{name}, pose {index} of tracklet {number}")
        lower = np.array([_number(pose, axis) for axis in ("tx", "ty", "tz")])
        angles = np.array([_number(pose, axis) for axis in ("rx", "ry", "rz")])
        yield _BoxRow(stated, lower, angles, (length, width, height))


def _number(element: Element, name: str) -> float:
    """A number that may be infinite or NaN: XML has text alone, and Python reads both from it."""
    text = element.findtext(name)
    if text is None:
        raise ValueError(f"{element.tag} has no number {name}")
    return float(text)


def _place_tracklet(row: _BoxRow) -> Float64:
    """[4, 4] in the axes of the LiDAR."""
    x_rad, y_rad, z_rad = row.angles_rad.tolist()
    turn = _rotate("z", z_rad) @ _rotate("y", y_rad) @ _rotate("x", x_rad)
    # The origin of a tracklet is the middle of its lower face.
    return _compose(turn, row.lower + turn @ np.array([0.0, 0.0, row.size_m[2] / 2]))


def read_tracking_labels(path: Path, frame_count: int, log: str) -> tuple[list[LabelledBox], tuple[Finding, ...]]:
    """Reads labels of the tracking benchmark, whose boxes are in the axes of the first grey camera, rectified.

    Args:
        path: text file, a line a box.
        frame_count: boxes of later frames are left out.
        log: URI of the log, for errors.

    Returns:
        The boxes, without regions that are not labelled, and ``invalid_box`` for each that cannot be used.

    Raises:
        InputError: a line has too few numbers, or all boxes are bad.
    """
    rows = []
    for number, line in enumerate(read_text(path, log).splitlines(), start=1):
        words = line.split()
        # Regions that nobody labelled have no box in space.
        if len(words) < 3 or words[2] == _NOT_LABELLED:
            continue
        what = f"line {number}"
        frame, track = (int(value) for value in parse_numbers(" ".join(words[:2]), 2, what, path, log))
        # The box in the image and its truncation lie between.
        values = parse_numbers(" ".join(words[10:]), 7, what, path, log, unchecked=True)
        height, width, length = values[:3].tolist()
        stated = StatedBox(frame, str(track), words[2], f"{path.name}, {what}")
        rows.append(_BoxRow(stated, values[3:6], values[6:], (length, width, height)))
    return _build_boxes(rows, _place_label, frame_count, path, log)


def _place_label(row: _BoxRow) -> Float64:
    """[4, 4] in the axes of the camera."""
    # At a turn of 0 the object heads along the camera's x; its origin is the middle of its lower face, y down.
    axes = _rotate("y", float(row.angles_rad[0])) @ _CAMERA_R_BOX
    return _compose(axes, row.lower - np.array([0.0, row.size_m[2] / 2, 0.0]))


def _build_boxes(
    rows: list[_BoxRow], place: Callable[[_BoxRow], Float64], frame_count: int, path: Path, log: str
) -> tuple[list[LabelledBox], tuple[Finding, ...]]:
    """The sound boxes of the log's frames with their poses, and findings of the others."""
    rows = [row for row in rows if 0 <= row.stated.frame < frame_count]
    if not rows:
        return [], ()
    centres, angles, sizes = (
        np.array([getattr(row, name) for row in rows]) for name in ("lower", "angles_rad", "size_m")
    )
    problems = find_bad_boxes(centres, sizes, angles_rad=angles)
    findings = report_bad_boxes(problems, len(rows), lambda index: rows[index].stated, file=path, log=log)
    boxes = []
    for index, row in enumerate(rows):
        if index not in problems:
            stated = row.stated
            boxes.append(LabelledBox(stated.frame, stated.track_id, stated.label, place(row), row.size_m))
    return boxes, findings


def _rotate(axis: str, angle_rad: float) -> Float64:
    from scipy.spatial.transform import Rotation

    matrix: Float64 = Rotation.from_euler(axis, angle_rad).as_matrix()
    return matrix


def _compose(rotation: Float64, position: Float64) -> Float64:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = position
    return pose
