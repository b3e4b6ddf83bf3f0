"""Arrays of a field of Gaussians as a cloud."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import colors_to_sh_dc, scales_to_logs
from genre_tasks.exchange.checks import check_finite_values
from genre_tasks.exchange.linear_light import linear_harmonics_to_srgb
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.exchange.usd import names
from genre_tasks.exchange.usd.color_spaces import is_linear
from genre_tasks.exchange.usd.stage_writer import LARGEST_OPACITY
from genre_tasks.logs.types import Float32
from genre_tasks.srgb import linear_to_srgb

_SMALLEST_OPACITY = 1e-30
"""Smaller ones become this one: the logit of 0 would be infinite."""

_HALF_ROUNDING = 1e-3


class FieldArrays:
    """The arrays of one field.

    Args:
        arrays: [N, width] float32 each, by the attribute's name.
        degree: of the spherical harmonics; ``None`` where the file does not state it.
        color_space: name of the colours' space; empty where the file does not state it.
        path: of the prim, for errors.
        file: for errors.
    """

    def __init__(
        self, arrays: Mapping[str, Float32], degree: int | None, color_space: str, path: str, file: Path
    ) -> None:
        self._arrays = arrays
        self._degree = degree
        self._color_space = color_space
        self._path = path
        self._file = file

    def to_cloud(self) -> SplatCloud:
        """Makes a cloud in the field's own coordinates and units.

        Returns:
            The cloud; scales are in the stage's units.

        Raises:
            InputError: arrays differ in length, or hold what is not finite or out of range.
        """
        means = self._take("positions", None)
        scales = self._take("scales", len(means))
        if (scales < 0).any():
            raise self._damage("has negative scales, which look like logarithms; OpenUSD's scales are linear")
        count = len(means)
        sh = self._take_harmonics(count)
        sh_dc = np.ascontiguousarray(sh[:, 0])
        sh_rest = np.ascontiguousarray(sh[:, 1:])
        # Where no space is stated they are sRGB, as 3DGS optimises them: files of ours were such once.
        if names.COEFFICIENTS in self._arrays and is_linear(self._color_space):
            sh_dc, sh_rest = linear_harmonics_to_srgb(sh_dc, sh_rest)
        # In memory OpenUSD's quaternions have the real part last.
        quats = np.roll(self._take("orientations", count, (0.0, 0.0, 0.0, 1.0)), 1, axis=1)
        return SplatCloud(
            means=means,
            log_scales=scales_to_logs(self._file, scales),
            quats=np.ascontiguousarray(quats),
            logit_opacities=self._to_logits(self._take("opacities", count, (1.0,))),
            sh_dc=sh_dc,
            sh_rest=sh_rest,
        )

    def _take(self, name: str, count: int | None, default: tuple[float, ...] | None = None) -> Float32:
        values = self._arrays.get(name)
        if values is None and default is None:
            raise self._damage(f"has no {name}")
        if values is None:
            return np.tile(np.array(default, np.float32), (count or 0, 1))
        if count is not None and len(values) != count:
            raise self._damage(f"has {len(values)} {name} for {count} positions")
        check_finite_values(self._file, f"{self._path}.{name}", values)
        return values

    def _take_harmonics(self, count: int) -> Float32:
        """Coefficients [N, 1 + K, 3], the constant one first."""
        if names.COEFFICIENTS not in self._arrays:
            return self._take_display_color(count)
        values = self._take(names.COEFFICIENTS, None)
        if self._degree is not None:
            if not 0 <= self._degree < len(SH_REST_COUNTS):
                raise self._damage(f"has spherical harmonics of degree {self._degree}, and 0 to 4 are read")
            per_gaussian = 1 + SH_REST_COUNTS[self._degree]
        else:
            # Degree 3 by the schema; where that does not fit, the number of coefficients leaves one degree at most.
            fitting = [1 + rest for rest in (15, *SH_REST_COUNTS) if (1 + rest) * count == len(values)]
            per_gaussian = fitting[0] if fitting else 16
        if len(values) != count * per_gaussian:
            expected = count * per_gaussian
            raise self._damage(f"has {len(values)} coefficients for {count} positions, expected {expected}")
        return values.reshape(count, per_gaussian, 3)

    def _take_display_color(self, count: int) -> Float32:
        values = self._arrays.get(names.COLORS)
        if values is None:
            return np.zeros((count, 1, 3), np.float32)
        if len(values) not in (1, count):
            raise self._damage(f"has {len(values)} colours for {count} positions")
        check_finite_values(self._file, f"{self._path}.{names.COLORS}", values)
        colors = values.astype(np.float64)
        # Other than harmonics: for an attribute that all of OpenUSD has, no stated space means linear light.
        if not self._color_space or is_linear(self._color_space):
            colors = linear_to_srgb(colors)
        return np.broadcast_to(colors_to_sh_dc(colors)[:, None], (count, 1, 3))

    def _to_logits(self, opacities: Float32) -> Float32:
        if ((opacities < -_HALF_ROUNDING) | (opacities > 1 + _HALF_ROUNDING)).any():
            raise self._damage("has opacities outside of 0 to 1, which look like logits; OpenUSD's are plain")
        # Finer than the clamp of files with steps: float32 holds opacities far below a millionth.
        inside = np.clip(opacities[:, 0].astype(np.float64), _SMALLEST_OPACITY, LARGEST_OPACITY)
        return np.asarray(np.log(inside) - np.log1p(-inside), np.float32)

    def _damage(self, problem: str) -> InputError:
        return InputError(f"{self._path} {problem}", remedy="Export the scene again.", file=self._file)
