"""Compressed PLY files of SuperSplat: 256 Gaussians share their ranges, and a Gaussian takes 16 bytes; read only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import colors_to_sh_dc, opacities_to_logits
from genre_tasks.exchange.checks import check_finite_cloud, check_finite_values
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.ply_header import PlyHeader, PlyTable, read_ply_header
from genre_tasks.exchange.types import SH_REST_COUNTS, ExchangeScene, SplatCloud
from genre_tasks.logs.types import Float32, Float64

CHUNK_SIZE = 256
"""How many Gaussians share their ranges."""

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_REMEDY = "Give a .compressed.ply file that SuperSplat or splat-transform has written."
# Harmonics lie between −4 and 4: 256 steps, whose ends are the ends of the range.
_SH_RANGE = 8.0
_LOSS = "The file holds positions, scales and colours in coarse steps; nothing of that can be brought back."


class CompressedPlyFormat:
    """The format; see :class:`genre_tasks.exchange.types.ExchangeFormat`. SPZ is its better successor for writing."""

    name = "compressed.ply"
    suffixes = (".compressed.ply",)
    can_write = False
    carries_nodes = False

    def read(self, path: Path) -> ExchangeScene:
        """Reads a file.

        Args:
            path: of the file.

        Returns:
            A scene of one node that rests.

        Raises:
            InputError: the file is no compressed PLY, is cut off, or has ranges that are not finite.
        """
        header = read_ply_header(path)
        vertices = _take_table(path, header, "vertex", _PACKED, "u4")
        corners = [f"{end}_{axis}" for axis in ("x", "y", "z") for end in ("min", "max")]
        scales = [f"{end}_scale_{axis}" for axis in ("x", "y", "z") for end in ("min", "max")]
        chunks = _take_table(path, header, "chunk", (*corners, *scales), "f4")
        if chunks.count * CHUNK_SIZE < vertices.count:
            problem = f"{vertices.count} Gaussians need {-(-vertices.count // CHUNK_SIZE)} chunks, not {chunks.count}"
            raise InputError(problem, remedy=_REMEDY, file=path)
        with path.open("rb") as stream:
            ranges = chunks.read_rows(stream, 0, chunks.count)
            packed = vertices.read_rows(stream, 0, vertices.count)
        for name in ranges.dtype.names or ():
            if ranges.dtype[name].kind == "f":
                check_finite_values(path, f"the chunks' {name}", ranges[name].astype(np.float32))
        # Each Gaussian's chunk.
        owner = np.arange(vertices.count) // CHUNK_SIZE
        rgba = _unpack_rgba(packed["packed_color"])
        # Ranges that are finite may still be too wide for float32: what becomes infinite is refused below.
        with np.errstate(over="ignore"):
            cloud = SplatCloud(
                means=_unpack_in_ranges(packed["packed_position"], ranges, owner, ""),
                log_scales=_unpack_in_ranges(packed["packed_scale"], ranges, owner, "scale_"),
                quats=unpack_smallest_three(packed["packed_rotation"]),
                logit_opacities=opacities_to_logits(rgba[:, 3]),
                sh_dc=colors_to_sh_dc(_scale_colors(rgba[:, :3], ranges, owner)),
                sh_rest=_read_sh(path, header, vertices.count),
            )
        check_finite_cloud(path, cloud)
        return make_resting_scene(cloud, (_LOSS,))

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Refuses: the format is read only.

        Args:
            path: of the file.
            scene: any.

        Raises:
            InputError: always.
        """
        remedy = "Choose spz, which is smaller and more exact, or ply."
        raise InputError("compressed.ply is read and not written", remedy=remedy, file=path)

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Says that nothing is written.

        Args:
            scene: any.
        """
        return ("The format is not written.",)


def unpack_smallest_three(packed: NDArray[np.uint32]) -> Float32:
    """Unpacks unit quaternions of which the largest component is left out.

    Args:
        packed: [N] the largest component's index in the top 2 bits, then the others, 10 bits each, w first.

    Returns:
        [N, 4] w first.

    >>> unpack_smallest_three(np.array([(512 << 20) + (512 << 10) + 512], np.uint32)).round(2).tolist()
    [[1.0, 0.0, 0.0, 0.0]]
    """
    steps = np.stack([packed >> 20, packed >> 10, packed], 1) & 1023
    # None of the three is larger than √½.
    smallest = (steps / 1023 - 0.5) * np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (smallest**2).sum(1)))
    index = (packed >> 30).astype(np.int64)
    quats = np.empty((len(packed), 4))
    for k in range(4):
        rows = index == k
        quats[rows] = np.insert(smallest[rows], k, largest[rows], axis=1)
    return quats.astype(np.float32)


def _take_table(path: Path, header: PlyHeader, element: str, names: tuple[str, ...], kind: str) -> PlyTable:
    table = header.tables.get(element)
    if table is None:
        problem = f"the PLY file has no {element} element, and so is no compressed PLY"
        raise InputError(problem, remedy=_REMEDY, file=path)
    for name in names:
        # Byte order may be either; a single byte has none.
        if name not in (table.row.names or ()) or table.row[name].str[1:] != kind:
            problem = f"the {element} element has no property {name} of the type that SuperSplat writes"
            raise InputError(problem, remedy=_REMEDY, file=path)
    return table


def _unpack_in_ranges(
    packed: NDArray[np.uint32], ranges: NDArray[np.void], owner: NDArray[np.int64], prefix: str
) -> Float32:
    """[N, 3] of 11, 10 and 11 bits, between the least and the largest of their chunk."""
    out = np.empty((len(packed), 3), np.float32)
    for column, (axis, shift, bits) in enumerate((("x", 21, 11), ("y", 11, 10), ("z", 0, 11))):
        top = (1 << bits) - 1
        part = ((packed >> shift) & top) / top
        low = ranges[f"min_{prefix}{axis}"].astype(np.float64)[owner]
        high = ranges[f"max_{prefix}{axis}"].astype(np.float64)[owner]
        out[:, column] = low * (1 - part) + high * part
    return out


def _unpack_rgba(packed: NDArray[np.uint32]) -> Float64:
    return (np.stack([packed >> 24, packed >> 16, packed >> 8, packed], 1) & 255) / 255


def _scale_colors(colors: Float64, ranges: NDArray[np.void], owner: NDArray[np.int64]) -> Float64:
    names = ranges.dtype.names or ()
    # Files of SuperSplat 1 have no ranges of colours: they are from 0 to 1.
    if not {f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"} <= set(names):
        return colors
    low = np.stack([ranges[f"min_{channel}"].astype(np.float64) for channel in "rgb"], 1)[owner]
    high = np.stack([ranges[f"max_{channel}"].astype(np.float64) for channel in "rgb"], 1)[owner]
    return np.asarray(low + colors * (high - low))


def _read_sh(path: Path, header: PlyHeader, count: int) -> Float32:
    if "sh" not in header.tables:
        return np.zeros((count, 0, 3), np.float32)
    table = header.tables["sh"]
    columns = len(table.row.names or ())
    if columns not in [3 * rest for rest in SH_REST_COUNTS] or table.count != count:
        problem = f"the harmonics are {table.count} rows of {columns}, and do not fit {count} Gaussians"
        raise InputError(problem, remedy=_REMEDY, file=path)
    names = tuple(f"f_rest_{k}" for k in range(columns))
    _take_table(path, header, "sh", names, "u1")
    with path.open("rb") as stream:
        rows = table.read_rows(stream, 0, count)
    out = np.empty((count, columns // 3, 3), np.float32)
    for k, name in enumerate(names):
        steps = rows[name].astype(np.float32)
        part = np.where(steps == 0, 0, np.where(steps == 255, 1, (steps + 0.5) / 256))
        # All reds come first, then all greens, then all blues.
        out[:, k % (columns // 3), k // (columns // 3)] = (part - 0.5) * _SH_RANGE
    return out


COMPRESSED_PLY = CompressedPlyFormat()
