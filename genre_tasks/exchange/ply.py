"""PLY files of 3D Gaussians, as 3DGS, gsplat, nerfstudio, SuperSplat, Brush and Postshot write them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import opacities_to_logits
from genre_tasks.exchange.checks import check_finite_cloud, check_finite_values
from genre_tasks.exchange.one_cloud import describe_one_cloud_losses, make_resting_scene, take_one_cloud
from genre_tasks.exchange.ply_header import PlyTable, read_ply_header
from genre_tasks.exchange.types import SH_REST_COUNTS, ExchangeScene, SplatCloud
from genre_tasks.logs.types import Float32
from genre_tasks.scene.gaussians import OPACITY_CLAMP

# Rows that are read at once: a few megabytes, whatever the file's size.
_ROWS = 1 << 14
_MEANS = ("x", "y", "z")
_LOG_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_SH_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_OPACITY = "opacity"
_REQUIRED = (*_MEANS, *_SH_DC, _OPACITY, *_LOG_SCALES, *_QUATS)
# 3DGS writes normals of zero, which mean nothing.
_MEANINGLESS = frozenset({"nx", "ny", "nz"})
_SH_REST = re.compile(r"f_rest_\d+")
_LISTED = 6
# Brush and Postshot each write their own sign of anti-aliasing.
_RENDER_MODE = re.compile(r"\s*splatrendermode\s*:\s*(default|mip|2dgs)\s*", re.IGNORECASE)
_ANTIALIASED = re.compile(r"\s*antialiased\s*:?\s*([01])\s*", re.IGNORECASE)
_TWO_DIMENSIONAL = "the file holds flat 2D Gaussians (2DGS), which are not rendered"
_REMEDY = "Give a PLY file that a 3DGS tool has written: x, y, z, f_dc_*, opacity, scale_0 to 2 and rot_0 to 3."


class PlyFormat:
    """The format; see :class:`genre_tasks.exchange.types.ExchangeFormat`. It keeps every bit of a cloud."""

    name = "ply"
    suffixes = (".ply",)
    can_write = True
    carries_nodes = False

    def read(self, path: Path) -> ExchangeScene:
        """Reads a binary PLY file of either byte order; properties are found by their names.

        Memory is that of the Gaussians and of a few megabytes of the file.

        Args:
            path: of the file.

        Returns:
            A scene of one node that rests.

        Raises:
            InputError: the file holds no 3D Gaussians, is cut off, or holds what is not finite.
        """
        header = read_ply_header(path)
        table = header.tables.get("vertex")
        if table is None:
            raise InputError("the PLY file has no vertices", remedy=_REMEDY, file=path)
        antialiased = _parse_antialiasing(path, header.comments)
        sh_names = _check_properties(path, table)
        cloud, bounded = _read_cloud(path, table, sh_names, antialiased)
        losses = _describe_unread(header.tables, sh_names)
        if bounded:
            losses += (f"Infinite opacities of {bounded} Gaussians become those of 1 and 0, less {OPACITY_CLAMP:g}.",)
        return make_resting_scene(cloud, losses)

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Writes a binary little-endian PLY file without normals.

        Args:
            path: of the file; an existing one is replaced.
            scene: with one resting node.

        Raises:
            InputError: the scene has several nodes, or holds what is not finite.
        """
        cloud = take_one_cloud(path, scene)
        check_finite_cloud(path, cloud)
        comments = []
        if cloud.antialiased is not None:
            # Readers know one of these each.
            mode = "mip" if cloud.antialiased else "default"
            comments = [f"SplatRenderMode: {mode}", f"antialiased {int(cloud.antialiased)}"]
        row = _describe_row(cloud.sh_rest.shape[1])
        # One row stands for all: a header needs their type and number alone.
        rows = np.broadcast_to(np.zeros(1, row), len(cloud))
        header = PlyData([PlyElement.describe(rows, "vertex")], byte_order="<", comments=comments).header
        with path.open("wb") as stream:
            stream.write(f"{header}\n".encode("ascii"))
            for start in range(0, len(cloud), _ROWS):
                stream.write(_pack_rows(cloud.select(slice(start, start + _ROWS))).tobytes())

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Lists what of a scene the format cannot carry: parts, motion and the place in the world.

        Args:
            scene: to be written.
        """
        return describe_one_cloud_losses(scene)


def _parse_antialiasing(path: Path, comments: tuple[str, ...]) -> bool | None:
    mode = None
    for comment in comments:
        if found := _RENDER_MODE.fullmatch(comment):
            mode = found[1].lower()
        elif found := _ANTIALIASED.fullmatch(comment):
            mode = "mip" if found[1] == "1" else "default"
    if mode == "2dgs":
        raise InputError(_TWO_DIMENSIONAL, remedy=_REMEDY, file=path)
    return None if mode is None else mode == "mip"


def _check_properties(path: Path, table: PlyTable) -> tuple[str, ...]:
    """Checks names and types; gives the names of harmonics in their order."""
    names = table.row.names or ()
    if "packed_position" in names:
        remedy = "Rename it so that its name ends in .compressed.ply."
        raise InputError("the file is a compressed PLY of SuperSplat", remedy=remedy, file=path)
    missing = [name for name in _REQUIRED if name not in names]
    if missing == ["scale_2"]:
        raise InputError(_TWO_DIMENSIONAL, remedy=_REMEDY, file=path)
    if missing:
        listed = ", ".join(missing[:_LISTED]) + (" and others" if len(missing) > _LISTED else "")
        raise InputError(f"the vertices have no {listed}", remedy=_REMEDY, file=path)
    count = sum(_SH_REST.fullmatch(name) is not None for name in names)
    sh_names = tuple(f"f_rest_{k}" for k in range(count))
    if count not in [3 * rest for rest in SH_REST_COUNTS] or not set(sh_names) <= set(names):
        counts = ", ".join(str(3 * rest) for rest in SH_REST_COUNTS)
        problem = f"the vertices have {count} properties f_rest_*, and harmonics have {counts} from f_rest_0 on"
        raise InputError(problem, remedy=_REMEDY, file=path)
    for name in (*_REQUIRED, *sh_names):
        if table.row[name].kind != "f":
            problem = f"the property {name} is {table.row[name].name}, and Gaussians have float"
            raise InputError(problem, remedy=_REMEDY, file=path)
    return sh_names


def _describe_unread(tables: dict[str, PlyTable], sh_names: tuple[str, ...]) -> tuple[str, ...]:
    known = {*_REQUIRED, *sh_names, *_MEANINGLESS}
    unread = [name for name in tables["vertex"].row.names or () if name not in known]
    unread += [f"all of {name}" for name in tables if name != "vertex"]
    if not unread:
        return ()
    more = f" and {len(unread) - _LISTED} more" if len(unread) > _LISTED else ""
    return (f"The file also has {', '.join(unread[:_LISTED])}{more}, which is not read.",)


def _read_cloud(
    path: Path, table: PlyTable, sh_names: tuple[str, ...], antialiased: bool | None
) -> tuple[SplatCloud, int]:
    """The Gaussians, and how many infinite opacities were made finite."""
    count = table.count
    columns = len(sh_names) // 3
    cloud = SplatCloud(
        means=np.empty((count, 3), np.float32),
        log_scales=np.empty((count, 3), np.float32),
        quats=np.empty((count, 4), np.float32),
        logit_opacities=np.empty(count, np.float32),
        sh_dc=np.empty((count, 3), np.float32),
        sh_rest=np.empty((count, columns, 3), np.float32),
        antialiased=antialiased,
    )
    bounded = 0
    # Not through a memory map: its pages would count to the process's memory, and a file that another program cuts off
    # meanwhile would end the process.
    with path.open("rb") as stream:
        for start in range(0, count, _ROWS):
            rows = slice(start, min(start + _ROWS, count))
            block = table.read_rows(stream, rows.start, rows.stop)
            for attribute, names, target in _pair_attributes(cloud):
                _copy_columns(block, names, target[rows])
                if names == (_OPACITY,):
                    bounded += _bound_opacities(target[rows])
                check_finite_values(path, attribute, target[rows], start)
            # All reds come first, then all greens, then all blues.
            for channel in range(3):
                names = sh_names[channel * columns : (channel + 1) * columns]
                _copy_columns(block, names, cloud.sh_rest[rows, :, channel])
            check_finite_values(path, "sh_rest", cloud.sh_rest[rows], start)
    return cloud, bounded


def _bound_opacities(logits: Float32) -> int:
    """Makes infinite logits finite, in place; how many there were."""
    # Writers that take opacities of 0 and 1 from eight bits to logits leave these; NaN means nothing.
    infinite = np.isinf(logits)
    logits[infinite] = np.sign(logits[infinite]) * opacities_to_logits(np.array([1 - OPACITY_CLAMP]))
    return int(infinite.sum())


def _pair_attributes(cloud: SplatCloud) -> Iterator[tuple[str, tuple[str, ...], Float32]]:
    yield "means", _MEANS, cloud.means
    yield "log_scales", _LOG_SCALES, cloud.log_scales
    yield "quats", _QUATS, cloud.quats
    yield "logit_opacities", (_OPACITY,), cloud.logit_opacities[:, None]
    yield "sh_dc", _SH_DC, cloud.sh_dc


def _copy_columns(block: NDArray[np.void], names: tuple[str, ...], target: Float32) -> None:
    # What float32 does not hold becomes infinite, and is refused as such.
    with np.errstate(over="ignore", invalid="ignore"):
        for column, name in enumerate(names):
            target[:, column] = block[name]


def _describe_row(columns: int) -> np.dtype[np.void]:
    sh_names = (f"f_rest_{k}" for k in range(3 * columns))
    names = (*_MEANS, *_SH_DC, *sh_names, _OPACITY, *_LOG_SCALES, *_QUATS)
    return np.dtype([(name, "<f4") for name in names])


def _pack_rows(cloud: SplatCloud) -> NDArray[np.float32]:
    """[N, properties] in the order of :func:`_describe_row`."""
    # All reds come first, then all greens, then all blues.
    harmonics = cloud.sh_rest.transpose(0, 2, 1).reshape(len(cloud), 3 * cloud.sh_rest.shape[1])
    parts = (cloud.means, cloud.sh_dc, harmonics, cloud.logit_opacities[:, None], cloud.log_scales, cloud.quats)
    return np.concatenate(parts, axis=1, dtype="<f4")


PLY = PlyFormat()
