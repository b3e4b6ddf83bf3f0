"""KITTI's boxes: tracklets of raw recordings, and labels of the tracking benchmark."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree import ElementTree

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.file_reading import read_file
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


def read_tracklets(path: Path, log: str) -> list[LabelledBox]:
    """Reads the tracklets of a raw recording, whose boxes are in the axes of the LiDAR.

    Args:
        path: ``tracklet_labels.xml``.
        log: URI of the log, for errors.

    Returns:
        The boxes.

    Raises:
        InputError: the file is no XML of tracklets, is too large, or declares entities.
    """
    if path.stat().st_size > _MAX_XML_BYTES:
        raise InputError(f"the file has {path.stat().st_size} bytes", remedy=_REMEDY, file=path, log=log)
    data = read_file(path, log=log)
    # An entity may stand for gigabytes, or for another file. Boost, which wrote these, declares an empty type.
    if b"<!ENTITY" in data:
        raise InputError("the XML declares entities", remedy=_REMEDY, file=path, log=log)
    try:
        root = ElementTree.fromstring(data)  # noqa: S314 (without entities nothing can grow)
        return [box for number, item in enumerate(_find_items(root)) for box in _read_tracklet(item, number)]
    except (ElementTree.ParseError, ValueError, OverflowError) as error:
        raise InputError(f"the tracklets cannot be read ({error})", remedy=_REMEDY, file=path, log=log) from error


def _find_items(root: Element) -> list[Element]:
    tracklets = root.find("tracklets")
    if tracklets is None:
        raise ValueError("there is no element tracklets")
    return tracklets.findall("item")


def _read_tracklet(item: Element, number: int) -> Iterator[LabelledBox]:
    height, width, length = (_number(item, name) for name in "hwl")
    if not min(height, width, length) > 0:
        raise ValueError(f"tracklet {number} has no size")
    # A tracklet has a pose for every frame from there on.
    first = int(_number(item, "first_frame"))
    for index, pose in enumerate(item.findall("poses/item")):
        turn = _rotate("z", _number(pose, "rz")) @ _rotate("y", _number(pose, "ry")) @ _rotate("x", _number(pose, "rx"))
        # The origin of a tracklet is the middle of its lower face.
        lower = np.array([_number(pose, name) for name in ("tx", "ty", "tz")])
        box = _compose(turn, lower + turn @ np.array([0.0, 0.0, height / 2]))
        label = item.findtext("objectType", "unknown")
        yield LabelledBox(first + index, str(number), label, box, (length, width, height))


def _number(element: Element, name: str) -> float:
    text = element.findtext(name)
    # XML has text alone, and Python reads "nan" and "inf" as numbers.
    value = np.nan if text is None else float(text)
    if not np.isfinite(value):
        raise ValueError(f"{element.tag} has no number {name}")
    return value


def read_tracking_labels(path: Path, log: str) -> list[LabelledBox]:
    """Reads labels of the tracking benchmark, whose boxes are in the axes of the first grey camera, rectified.

    Args:
        path: text file, a line a box.
        log: URI of the log, for errors.

    Returns:
        The boxes, without regions that are not labelled.

    Raises:
        InputError: a line has too few numbers.
    """
    boxes = []
    for number, line in enumerate(read_text(path, log).splitlines()):
        words = line.split()
        # Regions that nobody labelled have no box in space.
        if len(words) < 3 or words[2] == _NOT_LABELLED:
            continue
        what = f"line {number + 1}"
        frame, track = (int(value) for value in parse_numbers(" ".join(words[:2]), 2, what, path, log))
        # The box in the image and its truncation lie between.
        values = parse_numbers(" ".join(words[10:]), 7, what, path, log)
        height, width, length, *lower, turn = (float(value) for value in values)
        if not min(height, width, length) > 0:
            raise InputError(f"{what}: the box has no size", remedy=_REMEDY, file=path, log=log, frame=frame)
        # At a turn of 0 the object heads along the camera's x; its origin is the middle of its lower face, y down.
        axes = _rotate("y", turn) @ _CAMERA_R_BOX
        centre = np.array(lower) - np.array([0.0, height / 2, 0.0])
        boxes.append(LabelledBox(frame, str(track), words[2], _compose(axes, centre), (length, width, height)))
    return boxes


def _rotate(axis: str, angle_rad: float) -> Float64:
    from scipy.spatial.transform import Rotation

    matrix: Float64 = Rotation.from_euler(axis, angle_rad).as_matrix()
    return matrix


def _compose(rotation: Float64, position: Float64) -> Float64:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = position
    return pose
