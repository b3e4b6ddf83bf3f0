"""Components of a segment: Parquet files, one folder a component."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from genre_tasks.bounded_parquet import FOR_COLUMNS, MemoryBound, RowReader, TableTooLargeError, read_bounded_table
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64

REMEDY = "Download this file of the dataset again."
TIME = "key.frame_timestamp_micros"

# Range images that no beam came back to compress well; JPEG images do not.
_FOR_LARGE_VALUES = MemoryBound(256 << 20, file_ratio=64, value_bytes=1, row_bytes=0)
_MAX_ROWS = 5_000_000
# Files of the tests of the dataset's own code state rotations in single precision.
_MAX_SKEW = 1e-3
_MAX_DISTANCE_M = 1e9


class ComponentTable:
    """A component of a segment.

    Args:
        path: Parquet file.
        component: prefix of its columns, such as ``LiDARComponent``.
        log: URI of the log, for errors.

    Raises:
        InputError: the file is no Parquet table.
    """

    def __init__(self, path: Path, component: str, log: str) -> None:
        self.path = path
        self.log = log
        self._component = component
        self._readers: dict[tuple[str, ...], RowReader] = {}
        try:
            metadata = pq.read_metadata(path)
            self._names = frozenset(metadata.schema.to_arrow_schema().names)
        except (OSError, ValueError, pa.ArrowException) as error:
            raise self.fault(f"the table cannot be read ({error})") from error
        self.row_count = metadata.num_rows
        if self.row_count > _MAX_ROWS:
            raise self.fault(f"the table has {self.row_count} rows, and {_MAX_ROWS} are allowed")

    def fault(self, problem: str, remedy: str = REMEDY, frame: int | None = None) -> InputError:
        """Describes what is wrong with the table.

        Args:
            problem: one clause.
            remedy: what the user can do.
            frame: log frame.

        Returns:
            The error, which names the file.
        """
        return InputError(problem, remedy=remedy, file=self.path, log=self.log, frame=frame)

    def column(self, field: str) -> str:
        """Names the column of a field.

        Args:
            field: such as ``pose.transform``, or a key such as ``key.camera_name``.
        """
        return field if field.startswith("key.") else f"[{self._component}].{field}"

    def has(self, field: str) -> bool:
        """Tells whether the table has a field.

        Args:
            field: as for :meth:`column`.
        """
        return self.column(field) in self._names

    def read(self, fields: Sequence[str], names: Sequence[str] = (), unchecked: Sequence[str] = ()) -> dict[str, Any]:
        """Reads columns of numbers, transforms or names.

        Args:
            fields: as for :meth:`column`.
            names: those of the fields that may be texts.
            unchecked: those of the fields whose numbers may be missing or not finite.

        Returns:
            Field → [N] float64 or int64, [N, K] float64 of a transform, or a list of texts. Unchecked fields are
            float64, with NaN for a number that is missing.

        Raises:
            InputError: a column is missing, has nulls, or holds something else.
        """
        missing = [self.column(field) for field in fields if not self.has(field)]
        if missing:
            problem = f"the table lacks {', '.join(missing)}; it has {', '.join(sorted(self._names)[:12])}"
            raise self.fault(problem, remedy="Give files of version 2 of the dataset.")
        try:
            table = read_bounded_table(self.path, FOR_COLUMNS, [self.column(field) for field in fields])
        except TableTooLargeError as error:
            raise self.fault(str(error)) from error
        except (OSError, ValueError, pa.ArrowException) as error:
            raise self.fault(f"the table cannot be read ({error})") from error
        found = {}
        for field in fields:
            convert = self._convert_unchecked if field in unchecked else self._convert
            found[field] = convert(field, table.column(self.column(field)))
        for field, values in found.items():
            is_expected = field in names if isinstance(values, list) else values.ndim == 1 + field.endswith("transform")
            if not is_expected:
                raise self.fault(f"{field} holds {table.column(self.column(field)).type}")
        return found

    def _convert(self, field: str, column: pa.ChunkedArray) -> Any:
        array = column.combine_chunks()
        if array.null_count:
            raise self.fault(f"{field} has nulls")
        if pa.types.is_string(array.type) or pa.types.is_large_string(array.type):
            return array.to_pylist()
        count = 0
        if pa.types.is_list(array.type) or pa.types.is_fixed_size_list(array.type):
            lengths = pc.unique(pc.list_value_length(array)).to_pylist()
            count = lengths[0] if lengths else 1
            array = array.flatten()
            if len(lengths) > 1 or array.null_count or not count:
                raise self.fault(f"lists of {field} have different lengths, or nulls")
        if pa.types.is_integer(array.type) and not count:
            return array.to_numpy(zero_copy_only=False).astype(np.int64)
        if not pa.types.is_floating(array.type):
            raise self.fault(f"{field} holds {column.type}")
        values = array.to_numpy(zero_copy_only=False).astype(np.float64)
        if not np.isfinite(values).all():
            raise self.fault(f"{field} is not finite")
        return values.reshape(-1, count) if count else values

    def _convert_unchecked(self, field: str, column: pa.ChunkedArray) -> Float64:
        if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
            raise self.fault(f"{field} holds {column.type}")
        # Missing numbers become NaN.
        values: Float64 = column.combine_chunks().cast(pa.float64()).to_numpy(zero_copy_only=False)
        return values

    def read_poses(self, field: str) -> Float64:
        """Reads a column of poses.

        Args:
            field: lists of 16 numbers, row by row.

        Returns:
            [N, 4, 4] rigid poses.

        Raises:
            InputError: they are no poses.
        """
        values = self.read([field])[field]
        if values.shape[1] != 16:
            raise self.fault(f"{field} has no 16 numbers")
        poses: Float64 = values.reshape(-1, 4, 4).copy()
        # The nearest rotation: what is printed with few digits is none by itself.
        u, _, v = np.linalg.svd(poses[:, :3, :3])
        rotations = u @ v
        skew = np.abs(rotations - poses[:, :3, :3]).max(initial=0.0)
        if skew > _MAX_SKEW or (np.linalg.det(rotations) < 0).any():
            raise self.fault(f"{field} is no rotation and translation")
        if np.abs(poses[:, :3, 3]).max(initial=0.0) > _MAX_DISTANCE_M:
            raise self.fault(f"{field} leads out of the world")
        poses[:, :3, :3] = rotations
        poses[:, 3] = 0.0, 0.0, 0.0, 1.0
        return poses

    def read_row(self, row: int, fields: Sequence[str], frame: int) -> dict[str, Any]:
        """Reads large values of one row.

        Args:
            row: from 0.
            fields: as for :meth:`column`.
            frame: log frame, for errors.

        Returns:
            Field → Arrow scalar; without fields that the table lacks.

        Raises:
            InputError: the values cannot be read.
        """
        columns = tuple(self.column(field) for field in fields if self.has(field))
        if not columns:
            return {}
        try:
            # A reader goes on where it stopped, so that frames in their order are read once.
            if columns not in self._readers:
                self._readers[columns] = RowReader(self.path, _FOR_LARGE_VALUES, columns)
            batch = self._readers[columns].read(row)
            batch.validate(full=True)
            return {field: batch.column(self.column(field))[0] for field in fields if self.has(field)}
        except TableTooLargeError as error:
            raise self.fault(str(error), frame=frame) from error
        except (OSError, ValueError, pa.ArrowException) as error:
            raise self.fault(f"row {row} cannot be read ({error})", frame=frame) from error

    @cached_property
    def times_us(self) -> list[int]:
        """[N] microseconds of the rows' frames."""
        times = self.read([TIME])[TIME]
        if times.dtype != np.int64:
            raise self.fault(f"{TIME} holds {times.dtype}")
        whole: list[int] = times.tolist()
        return whole
