"""Gaussians as the attributes of a glTF primitive (KHR_gaussian_splatting), and back."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import (
    logits_to_opacities,
    logs_to_scales,
    opacities_to_logits,
    sh_dc_to_colors,
)
from genre_tasks.exchange.gltf.accessors import (
    BYTE,
    FLOAT,
    SHORT,
    UNSIGNED_BYTE,
    UNSIGNED_SHORT,
    AccessorReader,
    BufferBuilder,
)
from genre_tasks.exchange.gltf.document import SPLATTING, Primitive
from genre_tasks.exchange.linear_light import LINEAR_LOSS, linear_harmonics_to_srgb
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.logs.types import Float32
from genre_tasks.srgb import srgb_to_linear

MOST_SH_DEGREE = 3
"""Highest degree of harmonics that the extension knows."""

SRGB = "srgb_rec709_display"
"""Colour space of what 3DGS makes, and of what is written."""

LINEAR = "lin_rec709_display"
"""The other colour space of the extension, which is converted when it is read."""

_POINTS = 0
_ROTATION_KINDS = {(FLOAT, False), (BYTE, True), (SHORT, True)}
_SCALE_KINDS = {(FLOAT, False), *((kind, flag) for kind in (UNSIGNED_BYTE, UNSIGNED_SHORT) for flag in (False, True))}
_OPACITY_KINDS = {(FLOAT, False), (UNSIGNED_BYTE, True), (UNSIGNED_SHORT, True)}
_FLOATS = {(FLOAT, False)}
_SMALLEST_SCALE = float(np.finfo(np.float32).tiny)
_REMEDY = "Export it as uncompressed Gaussians with KHR_gaussian_splatting."


def add_primitive(path: Path, cloud: SplatCloud, builder: BufferBuilder) -> dict[str, Any]:
    """Adds Gaussians to a file.

    Args:
        path: of the file, for errors.
        cloud: one Gaussian or more, finite; harmonics above degree 3 are left out.
        builder: takes the arrays.

    Returns:
        JSON of the primitive. ``COLOR_0`` shows coloured points in tools without the extension.

    Raises:
        InputError: a scale does not fit into float32, or a quaternion has no direction.
    """
    attributes = {"POSITION": builder.add(cloud.means, of_vertices=True, bounds=True)}
    for name, values in _list_attributes(path, cloud):
        attributes[name] = builder.add(values, of_vertices=True)
    extension = {
        "kernel": "ellipse",
        "colorSpace": SRGB,
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    return {"attributes": attributes, "mode": _POINTS, "extensions": {SPLATTING: extension}}


def _list_attributes(path: Path, cloud: SplatCloud) -> Iterator[tuple[str, NDArray[Any]]]:
    opacities = logits_to_opacities(cloud.logit_opacities)[:, None]
    colors = srgb_to_linear(np.clip(sh_dc_to_colors(cloud.sh_dc), 0.0, 1.0))
    yield "COLOR_0", np.rint(255 * np.concatenate([colors, opacities], 1)).astype(np.uint8)
    yield f"{SPLATTING}:ROTATION", _normalize_quats(path, cloud.quats)
    yield f"{SPLATTING}:SCALE", logs_to_scales(path, cloud.log_scales)
    yield f"{SPLATTING}:OPACITY", opacities.astype(np.float32)
    yield _name_harmonic(0, 0), cloud.sh_dc
    for degree in range(1, min(cloud.sh_degree, MOST_SH_DEGREE) + 1):
        for n in range(2 * degree + 1):
            yield _name_harmonic(degree, n), cloud.sh_rest[:, degree**2 - 1 + n]


def _name_harmonic(degree: int, n: int) -> str:
    return f"{SPLATTING}:SH_DEGREE_{degree}_COEF_{n}"


def _normalize_quats(path: Path, quats: Float32) -> Float32:
    """Unit quaternions in glTF's order, x, y, z, w."""
    wide = quats.astype(np.float64)
    norms = np.linalg.norm(wide, axis=1, keepdims=True)
    if not norms.all():
        first = int(np.flatnonzero(norms == 0)[0])
        problem = f"the quaternion of Gaussian {first} (from 0 on) has no direction"
        raise InputError(problem, remedy="Leave this Gaussian out, or give it a rotation.", file=path)
    return np.roll(wide / norms, -1, axis=1).astype(np.float32)


def is_splats(primitive: Primitive) -> bool:
    """Whether a primitive is Gaussians.

    Args:
        primitive: of any kind.
    """
    return SPLATTING in primitive.extensions


def read_primitive(path: Path, primitive: Primitive, reader: AccessorReader) -> tuple[SplatCloud, tuple[str, ...]]:
    """Reads Gaussians of a file.

    Args:
        path: of the file, for errors.
        primitive: one that is Gaussians.
        reader: of the file's arrays.

    Returns:
        The Gaussians in their node's coordinates, and sentences on what is lost.

    Raises:
        InputError: the kernel or colour space is unknown, an attribute is missing, of another type or length, or has
            values that the extension does not allow.
    """
    linear = _check_extension(path, primitive)
    means = _read_attribute(path, primitive, reader, "POSITION", width=3, kinds=None, count=None)
    count = len(means)
    rotations = _read_attribute(
        path, primitive, reader, f"{SPLATTING}:ROTATION", width=4, kinds=_ROTATION_KINDS, count=count
    )
    scales = _read_attribute(path, primitive, reader, f"{SPLATTING}:SCALE", width=3, kinds=_SCALE_KINDS, count=count)
    opacities = _read_attribute(
        path, primitive, reader, f"{SPLATTING}:OPACITY", width=1, kinds=_OPACITY_KINDS, count=count
    )[:, 0]
    if (scales < 0).any() or (opacities < 0).any() or (opacities > 1).any():
        problem = "the file has scales below 0, or opacities outside of 0 to 1"
        raise InputError(problem, remedy="Export linear scales and opacities, without logarithms.", file=path)
    if not rotations.any(1).all():
        raise InputError("the file has quaternions without a direction", remedy=_REMEDY, file=path)
    sh_dc = _read_attribute(path, primitive, reader, _name_harmonic(0, 0), width=3, kinds=_FLOATS, count=count)
    sh_rest = _read_harmonics(path, primitive, reader, count)
    if linear:
        sh_dc, sh_rest = linear_harmonics_to_srgb(sh_dc, sh_rest)
    cloud = SplatCloud(
        means=means,
        # Flat Gaussians are allowed here, and have no logarithm.
        log_scales=np.log(np.maximum(scales.astype(np.float64), _SMALLEST_SCALE)).astype(np.float32),
        quats=np.roll(rotations, 1, axis=1),
        logit_opacities=opacities_to_logits(opacities.astype(np.float64)),
        sh_dc=sh_dc,
        sh_rest=sh_rest,
    )
    return cloud, (LINEAR_LOSS,) if linear else ()


def _check_extension(path: Path, primitive: Primitive) -> bool:
    """Whether the colours are linear light."""
    extension = primitive.extensions[SPLATTING]
    if not isinstance(extension, dict) or primitive.mode != _POINTS:
        raise InputError("the file's Gaussians are no points", remedy=_REMEDY, file=path)
    if extension.get("extensions"):
        names = ", ".join(sorted(extension["extensions"]))[:80] if isinstance(extension["extensions"], dict) else "…"
        raise InputError(f"the file's Gaussians need the extension {names}", remedy=_REMEDY, file=path)
    if extension.get("kernel") != "ellipse":
        shown = str(extension.get("kernel"))[:40]
        raise InputError(f"the file's Gaussians have the kernel {shown}", remedy="Export with ellipses.", file=path)
    space = extension.get("colorSpace")
    if space not in (SRGB, LINEAR):
        problem = f"the file's Gaussians have the colour space {str(space)[:40]}"
        raise InputError(problem, remedy=f"Export them as {SRGB}.", file=path)
    return bool(space == LINEAR)


def _read_attribute(
    path: Path,
    primitive: Primitive,
    reader: AccessorReader,
    name: str,
    *,
    width: int,
    kinds: set[tuple[int, bool]] | None,
    count: int | None,
) -> Float32:
    index = primitive.attributes.get(name)
    if index is None:
        raise InputError(f"the file's Gaussians have no {name}", remedy=_REMEDY, file=path)
    # Before it is read: an array of another length may be a long one.
    if count is not None and reader.count(index) != count:
        problem = f"{name} has {reader.count(index)} values for {count} Gaussians"
        raise InputError(problem, remedy=_REMEDY, file=path)
    return reader.read(index, width, kinds)


def _read_harmonics(path: Path, primitive: Primitive, reader: AccessorReader, count: int) -> Float32:
    degrees = range(1, MOST_SH_DEGREE + 1)
    found = [degree for degree in degrees if _name_harmonic(degree, 0) in primitive.attributes]
    columns = SH_REST_COUNTS[max(found, default=0)]
    reader.charge(12 * columns * count)
    sh_rest = np.empty((count, columns, 3), np.float32)
    # All lower degrees are read too, and one that is missing is an error.
    for degree in range(1, max(found, default=0) + 1):
        for n in range(2 * degree + 1):
            name = _name_harmonic(degree, n)
            values = _read_attribute(path, primitive, reader, name, width=3, kinds=_FLOATS, count=count)
            sh_rest[:, degree**2 - 1 + n] = values
    return sh_rest
