"""Reads cameras and images of COLMAP's sparse models, binary and text; points are not read.

The formats are those of https://colmap.github.io/format.html. Pixels count as in this project: (0.5, 0.5) is the middle
of the first one.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from genre_tasks.errors import InputError
from genre_tasks.logs.posed_images.posed_image import MAX_IMAGES, PosedImage, make_lens, make_pose
from genre_tasks.logs.types import Lens

_REMEDY = "Export the model again with `colmap model_converter`."
_MODELS = {
    0: "SIMPLE_PINHOLE",
    1: "PINHOLE",
    2: "SIMPLE_RADIAL",
    3: "RADIAL",
    4: "OPENCV",
    5: "OPENCV_FISHEYE",
    6: "FULL_OPENCV",
    7: "FOV",
    8: "SIMPLE_RADIAL_FISHEYE",
    9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
    11: "RAD_TAN_THIN_PRISM_FISHEYE",
}
# Which parameter is fx, fy, cx, cy, k1, k2, p1, p2; where none is, the coefficient is 0.
_PARAMETERS: dict[str, tuple[int | None, ...]] = {
    "SIMPLE_PINHOLE": (0, 0, 1, 2, None, None, None, None),
    "PINHOLE": (0, 1, 2, 3, None, None, None, None),
    "SIMPLE_RADIAL": (0, 0, 1, 2, 3, None, None, None),
    "RADIAL": (0, 0, 1, 2, 3, 4, None, None),
    "OPENCV": (0, 1, 2, 3, 4, 5, 6, 7),
}
_POINT_BYTES = 24
_MAX_NAME_BYTES = 4096
_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "0")


class _CameraRow(NamedTuple):
    number: int
    model: str
    width_px: int
    height_px: int
    parameters: tuple[float, ...]


class _ImageRow(NamedTuple):
    name: str
    camera: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]


def find_colmap_model(folder: Path) -> Path | None:
    """Finds the sparse model in a folder.

    Args:
        folder: the model's, or that of the project around it.

    Returns:
        The folder that holds cameras and images, ``None`` if there is none.
    """
    for name in _FOLDERS:
        for suffix in (".bin", ".txt"):
            if (folder / name / f"images{suffix}").is_file() and (folder / name / f"cameras{suffix}").is_file():
                return folder / name
    return None


def read_colmap_model(folder: Path) -> tuple[PosedImage, ...]:
    """Reads the registered images of a sparse model.

    Args:
        folder: from :func:`find_colmap_model`.

    Returns:
        The images, in the order of the file; ``camera`` is the model's number of the camera.

    Raises:
        InputError: a file is unreadable, cut off or unsound, or a camera has a model that is not supported.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras_file = folder / f"cameras{suffix}"
    images_file = folder / f"images{suffix}"
    read_cameras = _read_binary_cameras if suffix == ".bin" else _read_text_cameras
    read_images = _read_binary_images if suffix == ".bin" else _read_text_images
    try:
        lenses = {row.number: _make_lens(row, cameras_file) for row in read_cameras(cameras_file)}
        rows = list(read_images(images_file))
    # What a cut-off or damaged file makes of the formats below.
    except (OSError, ValueError, IndexError, struct.error) as error:
        raise InputError(f"the COLMAP model cannot be read: {error}", remedy=_REMEDY, file=folder) from error
    if not rows:
        raise InputError("the COLMAP model has no registered image", remedy=_REMEDY, file=images_file)
    return tuple(_make_image(row, lenses, images_file) for row in rows)


def _make_lens(row: _CameraRow, file: Path) -> Lens:
    columns = _PARAMETERS.get(row.model)
    if columns is None:
        raise InputError(
            f"camera {row.number} has the model {row.model}, which is not supported",
            remedy=f"Supported are {', '.join(_PARAMETERS)}; `colmap image_undistorter` makes PINHOLE of any.",
            file=file,
        )
    values = [0.0 if column is None else row.parameters[column] for column in columns]
    return make_lens(
        focal_px=(values[0], values[1]),
        center_px=(values[2], values[3]),
        size_px=(row.width_px, row.height_px),
        distortion=tuple(values[4:]),
        file=file,
    )


def _make_image(row: _ImageRow, lenses: dict[int, Lens], file: Path) -> PosedImage:
    if row.camera not in lenses:
        raise InputError(f"{row.name} has camera {row.camera}, which the model lacks", remedy=_REMEDY, file=file)
    w, x, y, z = row.quat
    length = float(np.linalg.norm(row.quat))
    if not np.isfinite([*row.quat, *row.translation]).all() or length == 0:
        raise InputError(f"the pose of {row.name} is not finite", remedy=_REMEDY, file=file)
    # COLMAP states the world in camera coordinates.
    rotation = Rotation.from_quat([x, y, z, w]).as_matrix().T
    matrix = np.eye(4)
    matrix[:3, :3] = rotation
    matrix[:3, 3] = -rotation @ np.array(row.translation)
    return PosedImage(row.name, make_pose(matrix, row.name, file), lenses[row.camera], str(row.camera))


def _read_binary_cameras(file: Path) -> Iterator[_CameraRow]:
    with file.open("rb") as stream:
        for _ in range(_read_count(stream)):
            number, model, width, height = struct.unpack("<iiQQ", stream.read(24))
            name = _MODELS.get(model, f"number {model}")
            count = max((c for c in _PARAMETERS.get(name, ()) if c is not None), default=-1) + 1
            # Only the length of a supported model is known; any other ends the reading with an error that names it.
            yield _CameraRow(number, name, width, height, struct.unpack(f"<{count}d", stream.read(8 * count)))


def _read_binary_images(file: Path) -> Iterator[_ImageRow]:
    size = file.stat().st_size
    with file.open("rb") as stream:
        for _ in range(_read_count(stream)):
            values = struct.unpack("<i7di", stream.read(64))
            name = _read_name(stream)
            (points,) = struct.unpack("<Q", stream.read(8))
            if points * _POINT_BYTES > size - stream.tell():
                raise ValueError(f"{file.name} ends within the points of {name}")
            # The observed points are most of the file, and nothing here needs them.
            stream.seek(points * _POINT_BYTES, 1)
            yield _ImageRow(name, values[8], values[1:5], values[5:8])


def _read_count(stream: BinaryIO) -> int:
    (count,) = struct.unpack("<Q", stream.read(8))
    if count > MAX_IMAGES:
        raise ValueError(f"{count} entries are claimed")
    return int(count)


def _read_name(stream: BinaryIO) -> str:
    name = bytearray()
    while (byte := stream.read(1)) != b"\0":
        if not byte or len(name) > _MAX_NAME_BYTES:
            raise ValueError("the name of an image does not end")
        name += byte
    return name.decode()


def _read_text_cameras(file: Path) -> Iterator[_CameraRow]:
    for line in file.read_text(encoding="utf-8").splitlines():
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *parameters = line.split()
            yield _CameraRow(int(number), model, int(width), int(height), tuple(map(float, parameters)))


def _read_text_images(file: Path) -> Iterator[_ImageRow]:
    with file.open(encoding="utf-8") as stream:
        for line in stream:
            if not line.strip() or line.startswith("#"):
                continue
            # Names may hold spaces.
            words = line.rstrip("\r\n").split(" ", 9)
            values = tuple(map(float, words[1:8]))
            yield _ImageRow(words[9], int(words[8]), values[:4], values[4:])
            # The next line has the observed points; it is there, if empty, for every image.
            next(stream, "")
