"""Reads this project's training sets: boxes at once, an image when it is asked for."""

from __future__ import annotations

import math
from dataclasses import fields
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.logs.file_reading import read_file
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.scene.image_decoding import decode_pixels
from genre_tasks.training_sets.labelled_images import LabelledBox, LabelledImage
from genre_tasks.training_sets.set_columns import (
    BOX_COLUMNS,
    BOXES_TABLE,
    DESCRIPTION,
    IMAGE_COLUMNS,
    IMAGES_TABLE,
    LAYOUT,
    LAYOUT_VERSION,
)

_REMEDY = "Write the set again with `genre augment --format own`."
_MATRIX = 16


class StoredImage(LabelledImage):
    """A labelled image of a training set, whose pixels are read whenever they are asked for."""

    @classmethod
    def from_file(cls, file: Path, **values: Any) -> StoredImage:
        """Makes an image without reading the file.

        Args:
            file: PNG of the lens's size.
            values: all other attributes.
        """
        made = object.__new__(cls)
        # The class is frozen, and lacks its image.
        for name, value in {**values, "_file": file}.items():
            object.__setattr__(made, name, value)
        return made

    def __getattr__(self, name: str) -> Any:
        # Python asks for what the instance lacks.
        if name != "image":
            raise AttributeError(name)
        lens = self.lens
        file: Path = self.__dict__["_file"]
        data = read_file(file, log=self.log, camera=self.camera, frame=self.frame)
        try:
            return decode_pixels(data, lens.width_px, lens.height_px)
        except InputError as error:
            raise InputError(error.problem, remedy=_REMEDY, file=file) from error


def read_training_set(folder: Path) -> list[LabelledImage]:
    """Reads a training set that ``genre augment --format own`` has written.

    Args:
        folder: of the set.

    Returns:
        Its images in the order of writing; their pixels are read when ``image`` is asked for, and not kept.

    Raises:
        InputError: there is no such set, or a table is damaged or lacks a column.
    """
    description = read_json_object(folder / DESCRIPTION, "description of the training set", _REMEDY)
    if description.get("layout") != LAYOUT or description.get("version") != LAYOUT_VERSION:
        problem = f"the folder is no training set of version {LAYOUT_VERSION}"
        raise InputError(problem, remedy=_REMEDY, file=folder / DESCRIPTION)
    boxes_of: dict[int, list[LabelledBox]] = {}
    path = folder / BOXES_TABLE
    for number, row in enumerate(_read_rows(path, tuple(BOX_COLUMNS), optional=("occluded",))):
        boxes_of.setdefault(row["image"], []).append(_build_box(row, number, path))
    path = folder / IMAGES_TABLE
    rows = _read_rows(path, tuple(IMAGE_COLUMNS))
    unknown = set(boxes_of) - {row["image"] for row in rows}
    if unknown:
        raise InputError(f"a box is of image {min(unknown)}, which is not there", remedy=_REMEDY, file=path)
    return [_build_image(row, number, folder, tuple(boxes_of.get(row["image"], ()))) for number, row in enumerate(rows)]


def _read_rows(path: Path, columns: tuple[str, ...], optional: tuple[str, ...] = ()) -> list[dict[str, Any]]:
    import pyarrow as pa

    from genre_tasks.bounded_parquet import FOR_COLUMNS, read_bounded_table

    try:
        table = read_bounded_table(path, FOR_COLUMNS)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(f"the table cannot be read ({error})", remedy=_REMEDY, file=path) from error
    missing = [name for name in columns if name not in table.column_names]
    if missing:
        raise InputError(f"the table lacks the columns {', '.join(missing)}", remedy=_REMEDY, file=path)
    empty = [name for name in columns if name not in optional and table.column(name).null_count]
    if empty:
        raise InputError(f"values are missing in {', '.join(empty)}", remedy=_REMEDY, file=path)
    rows: list[dict[str, Any]] = table.select(list(columns)).to_pylist()
    return rows


def _build_box(row: dict[str, Any], number: int, path: Path) -> LabelledBox:
    try:
        left, top, right, bottom = (float(row[f"{name}_px"]) for name in ("left", "top", "right", "bottom"))
        length, width, height = (float(row[f"{name}_m"]) for name in ("length", "width", "height"))
        x, y, z = (float(row[f"velocity_{axis}_m_s"]) for axis in "xyz")
        return LabelledBox(
            track_id=str(row["track_id"]),
            label=str(row["label"]),
            size_m=(length, width, height),
            camera_SE3_box=_build_matrix(row["camera_SE3_box"]),
            box_px=(left, top, right, bottom),
            truncated=float(row["truncated"]),
            occluded=math.nan if row["occluded"] is None else float(row["occluded"]),
            lidar_points=int(row["lidar_points"]),
            velocity_m_s=(x, y, z),
        )
    except (TypeError, ValueError) as error:
        raise InputError(f"row {number} is no box ({error})", remedy=_REMEDY, file=path) from error


def _build_image(row: dict[str, Any], number: int, folder: Path, boxes: tuple[LabelledBox, ...]) -> LabelledImage:
    table = folder / IMAGES_TABLE
    file = PurePosixPath(str(row["file"]))
    # A table must not make the reader open files elsewhere.
    if file.is_absolute() or ".." in file.parts:
        raise InputError(f"row {number} names a file outside of the set", remedy=_REMEDY, file=table)
    try:
        fx_px, fy_px, cx_px, cy_px = (float(row[name]) for name in ("fx_px", "fy_px", "cx_px", "cy_px"))
        distortion = tuple(float(value) for value in row["distortion"])
        lens = Lens(fx_px, fy_px, cx_px, cy_px, int(row["width_px"]), int(row["height_px"]), distortion)
        poses = {name: _build_matrix(row[name]) for name in ("world_SE3_camera", "world_SE3_ego")}
        kinds = {"log": str, "camera": str, "frame": int, "timestamp_s": float, "shift_m": float, "rendered": bool}
        facts = {name: kind(row[name]) for name, kind in kinds.items()}
    except (TypeError, ValueError) as error:
        raise InputError(f"row {number} is no image ({error})", remedy=_REMEDY, file=table) from error
    values = {**facts, **poses, "lens": lens, "boxes": boxes}
    assert set(values) == {field.name for field in fields(LabelledImage)} - {"image"}
    return StoredImage.from_file(folder / file, **values)


def _build_matrix(numbers: list[float]) -> Float64:
    matrix = np.array(numbers, dtype=np.float64)
    if matrix.size != _MATRIX or not np.isfinite(matrix).all():
        raise ValueError("a matrix of 16 finite numbers was expected")
    return matrix.reshape(4, 4)
