"""Training sets that anyone can open: images as PNG, two Parquet tables, and a description of their columns."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from genre_tasks.training_sets.image_files import name_image, write_image, write_json
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

Row = dict[str, Any]


class ParquetWriter:
    """Writes a training set image by image; the tables at the end.

    Args:
        root: an empty folder.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._images: list[Row] = []
        self._boxes: list[Row] = []

    def add(self, labelled: LabelledImage) -> None:
        """Writes an image.

        Args:
            labelled: of any lens.
        """
        number = len(self._images)
        file = f"images/{number:06d}_{name_image(labelled)}.png"
        write_image(self._root / file, labelled.image)
        lens = labelled.lens
        self._images.append(
            {
                "image": number,
                "file": file,
                "log": labelled.log,
                "camera": labelled.camera,
                "frame": labelled.frame,
                "timestamp_s": labelled.timestamp_s,
                "shift_m": labelled.shift_m,
                "rendered": labelled.rendered,
                "world_SE3_camera": labelled.world_SE3_camera.ravel().tolist(),
                "world_SE3_ego": labelled.world_SE3_ego.ravel().tolist(),
                **{name: getattr(lens, name) for name in ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")},
                "distortion": list(lens.distortion),
            }
        )
        self._boxes += [_describe_box(box, number) for box in labelled.boxes]

    def finish(self) -> None:
        """Writes tables and description."""
        _write_table(self._root / IMAGES_TABLE, self._images, IMAGE_COLUMNS)
        _write_table(self._root / BOXES_TABLE, self._boxes, BOX_COLUMNS)
        tables = {IMAGES_TABLE: IMAGE_COLUMNS, BOXES_TABLE: BOX_COLUMNS}
        # The description makes the set readable without this project.
        meanings = {file: {name: text for name, (_, text) in columns.items()} for file, columns in tables.items()}
        counts = {"images": len(self._images), "boxes": len(self._boxes)}
        about = "Images of driving logs, recorded and rendered, with the boxes of their annotation. Units are in names."
        description = {"layout": LAYOUT, "version": LAYOUT_VERSION, "about": about, **counts, "columns": meanings}
        write_json(self._root / DESCRIPTION, description)


def _describe_box(box: LabelledBox, image: int) -> Row:
    length, width, height = box.size_m
    left, top, right, bottom = box.box_px
    x, y, z = box.velocity_m_s
    return {
        "image": image,
        "track_id": box.track_id,
        "label": box.label,
        "length_m": length,
        "width_m": width,
        "height_m": height,
        "camera_SE3_box": box.camera_SE3_box.ravel().tolist(),
        "left_px": left,
        "top_px": top,
        "right_px": right,
        "bottom_px": bottom,
        "truncated": box.truncated,
        # NaN is a number to Parquet, and null what is not known.
        "occluded": None if math.isnan(box.occluded) else box.occluded,
        "lidar_points": box.lidar_points,
        "velocity_x_m_s": x,
        "velocity_y_m_s": y,
        "velocity_z_m_s": z,
    }


def _write_table(path: Path, rows: list[Row], columns: Mapping[str, tuple[str, str]]) -> None:
    # Imported here, because the command line should start without it.
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {
        "int64": pa.int64(),
        "double": pa.float64(),
        "string": pa.string(),
        "bool": pa.bool_(),
        "numbers": pa.list_(pa.float64()),
        "matrix": pa.list_(pa.float64(), 16),
    }
    # Stated and not inferred: a set without boxes has the same columns.
    schema = pa.schema([(name, kinds[kind]) for name, (kind, _) in columns.items()])
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), path, compression="zstd")
