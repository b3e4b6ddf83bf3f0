"""A field of Gaussians of a stage as a cloud, with attributes of float or half precision."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pxr import Usd, UsdGeom, UsdVol

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import colors_to_sh_dc, scales_to_logs
from genre_tasks.exchange.checks import check_finite_cloud, check_finite_values
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.exchange.usd.stage_writer import LARGEST_OPACITY
from genre_tasks.logs.types import Float32

_SMALLEST_OPACITY = 1e-30
"""Smaller ones become this one: the logit of 0 would be infinite."""

_HALF_ROUNDING = 1e-3


def is_field(prim: Any) -> bool:
    """Tells whether a prim is a field of Gaussians that are ellipsoids."""
    return bool(prim.HasAPI(UsdVol.ParticleFieldKernelGaussianEllipsoidAPI))


def read_cloud(prim: Any, file: Path, losses: list[str]) -> SplatCloud:
    """Reads a field in its own coordinates and units.

    Args:
        prim: a field.
        file: for errors.
        losses: gets a sentence for what is not read.

    Returns:
        The cloud; scales are in the stage's units.

    Raises:
        InputError: arrays differ in length, or hold what is not finite or out of range.
    """
    reader = _ArrayReader(prim, file, losses)
    means = reader.read("positions", 3)
    if means is None:
        raise reader.damage("has no positions")
    count = len(means)
    scales = reader.read("scales", 3, count)
    quats = reader.read("orientations", 4, count)
    opacities = reader.read("opacities", 1, count)
    sh = _read_harmonics(reader, count)
    if scales is None:
        raise reader.damage("has no scales")
    cloud = SplatCloud(
        means=means,
        log_scales=_read_log_scales(reader, scales),
        # In memory OpenUSD's quaternions have the real part last.
        quats=_identity_quats(count) if quats is None else np.ascontiguousarray(np.roll(quats, 1, axis=1)),
        logit_opacities=_read_logits(reader, np.ones((count, 1), np.float32) if opacities is None else opacities),
        sh_dc=np.ascontiguousarray(sh[:, 0]),
        sh_rest=np.ascontiguousarray(sh[:, 1:]),
    )
    check_finite_cloud(file, cloud)
    return cloud


class _ArrayReader:
    """Reads arrays of one field."""

    def __init__(self, prim: Any, file: Path, losses: list[str]) -> None:
        self.prim = prim
        self.file = file
        self._losses = losses

    def damage(self, problem: str) -> InputError:
        """An error about the field."""
        return InputError(f"{self.prim.GetPath()} {problem}", remedy="Export the scene again.", file=self.file)

    def read(self, name: str, width: int, count: int | None = None) -> Float32 | None:
        """Reads an attribute of float precision, or else that of half precision.

        Args:
            name: of the first of them.
            width: numbers of an entry.
            count: how many entries there must be; ``None`` for any number.

        Returns:
            [N, width] float32, or ``None`` where neither is there.
        """
        for attribute in (self.prim.GetAttribute(name), self.prim.GetAttribute(f"{name}h")):
            if not attribute or not attribute.HasAuthoredValue():
                continue
            if attribute.GetNumTimeSamples() > 1:
                self._losses.append(f"{self.prim.GetPath()}: of the changing {name} the first ones are read.")
            value = attribute.Get(Usd.TimeCode.EarliestTime())
            if value is None:
                continue
            values = np.asarray(value, dtype=np.float32).reshape(-1, width)
            if count is not None and len(values) != count:
                raise self.damage(f"has {len(values)} {name} for {count} positions")
            check_finite_values(self.file, f"{self.prim.GetPath()}.{name}", values)
            return values
        return None


def _read_harmonics(reader: _ArrayReader, count: int) -> Float32:
    """Coefficients [N, 1 + K, 3], the constant one first."""
    values = reader.read("radiance:sphericalHarmonicsCoefficients", 3)
    if values is None:
        return _read_display_color(reader, count)
    stated = reader.prim.GetAttribute("radiance:sphericalHarmonicsDegree")
    if stated and stated.HasAuthoredValue():
        degree = stated.Get()
        if not 0 <= degree < len(SH_REST_COUNTS):
            raise reader.damage(f"has spherical harmonics of degree {degree}, and 0 to 4 are read")
        per_gaussian = 1 + SH_REST_COUNTS[degree]
    else:
        # Degree 3 by the schema; where that does not fit, the number of coefficients leaves one degree at most.
        fitting = [1 + rest for rest in (15, *SH_REST_COUNTS) if (1 + rest) * count == len(values)]
        per_gaussian = fitting[0] if fitting else 16
    if len(values) != count * per_gaussian:
        raise reader.damage(f"has {len(values)} coefficients for {count} positions, expected {count * per_gaussian}")
    return values.reshape(count, per_gaussian, 3)


def _read_display_color(reader: _ArrayReader, count: int) -> Float32:
    color = UsdGeom.Gprim(reader.prim).GetDisplayColorPrimvar()
    value = color.ComputeFlattened() if color and color.HasAuthoredValue() else None
    if value is None:
        return np.zeros((count, 1, 3), np.float32)
    values = np.asarray(value, dtype=np.float32).reshape(-1, 3)
    if len(values) not in (1, count):
        raise reader.damage(f"has {len(values)} colours for {count} positions")
    check_finite_values(reader.file, f"{reader.prim.GetPath()}.displayColor", values)
    return np.broadcast_to(colors_to_sh_dc(values)[:, None], (count, 1, 3))


def _read_log_scales(reader: _ArrayReader, scales: Float32) -> Float32:
    if (scales < 0).any():
        raise reader.damage("has negative scales, which look like logarithms; OpenUSD's scales are linear")
    return scales_to_logs(reader.file, scales)


def _read_logits(reader: _ArrayReader, opacities: Float32) -> Float32:
    if ((opacities < -_HALF_ROUNDING) | (opacities > 1 + _HALF_ROUNDING)).any():
        raise reader.damage("has opacities outside of 0 to 1, which look like logits; OpenUSD's are plain")
    inside = np.clip(opacities[:, 0].astype(np.float64), _SMALLEST_OPACITY, LARGEST_OPACITY)
    return np.asarray(np.log(inside) - np.log1p(-inside), np.float32)


def _identity_quats(count: int) -> Float32:
    return np.tile(np.array([1.0, 0.0, 0.0, 0.0], np.float32), (count, 1))
