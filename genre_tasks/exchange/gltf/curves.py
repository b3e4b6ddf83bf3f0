"""Animated values over time: the samplers of glTF."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.exchange.gltf.accessors import BYTE, FLOAT, SHORT, UNSIGNED_BYTE, UNSIGNED_SHORT, AccessorReader
from genre_tasks.exchange.gltf.document import Sampler
from genre_tasks.logs.types import Float64

PATH_WIDTHS = {"translation": 3, "rotation": 4, "scale": 3}
"""Numbers of what a channel moves; other paths do not move Gaussians."""

_FLOATS = {(FLOAT, False)}
_ROTATION_KINDS = _FLOATS | {(kind, True) for kind in (BYTE, UNSIGNED_BYTE, SHORT, UNSIGNED_SHORT)}
# Of nearly equal quaternions the sine of their angle is no divisor.
_NEARLY_EQUAL = 0.9995
_REMEDY = "Export it again, or check it with a glTF validator."


class Curve(NamedTuple):
    """Keyframes.

    Attributes:
        times_s: [K] in rising order.
        values: [K, width], or [K, 3, width] for cubic splines: tangent in, value, tangent out.
        interpolation: LINEAR, STEP or CUBICSPLINE.
    """

    times_s: Float64
    values: Float64
    interpolation: str

    def evaluate(self, times_s: Float64) -> Float64:
        """Gives the values at moments; before the first and after the last keyframe they stay as they are there.

        Args:
            times_s: [F].

        Returns:
            [F, width]. Rotations, of width 4, are on the shorter arc between two keyframes.

        >>> curve = Curve(np.array([0.0, 1.0]), np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), "LINEAR")
        >>> curve.evaluate(np.array([0.5, 7.0]))[:, 0].tolist()
        [1.0, 2.0]
        """
        moments = np.clip(times_s, self.times_s[0], self.times_s[-1])
        before = np.searchsorted(self.times_s, moments, side="right") - 1
        if self.interpolation == "STEP":
            return np.asarray(self.values[before])
        after = np.minimum(before + 1, len(self.times_s) - 1)
        span = self.times_s[after] - self.times_s[before]
        fraction = ((moments - self.times_s[before]) / np.where(span > 0, span, 1.0))[:, None]
        if self.interpolation == "CUBICSPLINE":
            return _interpolate_cubic(self.values[before], self.values[after], fraction, span[:, None])
        if self.values.shape[1] == PATH_WIDTHS["rotation"]:
            return _interpolate_rotation(self.values[before], self.values[after], fraction)
        return np.asarray(self.values[before] * (1 - fraction) + self.values[after] * fraction)


def _interpolate_cubic(before: Float64, after: Float64, fraction: Float64, span: Float64) -> Float64:
    """Hermite splines, whose tangents are per second."""
    square = fraction * fraction
    cube = square * fraction
    return np.asarray(
        (2 * cube - 3 * square + 1) * before[:, 1]
        + span * (cube - 2 * square + fraction) * before[:, 2]
        + (3 * square - 2 * cube) * after[:, 1]
        + span * (cube - square) * after[:, 0]
    )


def _interpolate_rotation(before: Float64, after: Float64, fraction: Float64) -> Float64:
    cosine = (before * after).sum(1, keepdims=True)
    # A quaternion and its negative are one rotation: of the two the nearer one is turned to.
    nearer = np.where(cosine < 0, -after, after)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, _NEARLY_EQUAL))
    on_arc = (np.sin((1 - fraction) * angle) * before + np.sin(fraction * angle) * nearer) / np.sin(angle)
    on_chord = before * (1 - fraction) + nearer * fraction
    return np.where(np.abs(cosine) > _NEARLY_EQUAL, on_chord, on_arc)


def read_curve(path: Path, sampler: Sampler, moved: str, reader: AccessorReader) -> Curve:
    """Reads a sampler.

    Args:
        path: of the file, for errors.
        sampler: of an animation.
        moved: translation, rotation or scale.
        reader: of the file's arrays.

    Returns:
        Its keyframes.

    Raises:
        InputError: times do not rise, or there are more or fewer values than times, or a rotation has no direction.
    """
    times = reader.read(sampler.input, 1, _FLOATS)[:, 0].astype(np.float64)
    width = PATH_WIDTHS[moved]
    cubic = sampler.interpolation == "CUBICSPLINE"
    count = reader.count(sampler.output)
    if count != len(times) * (3 if cubic else 1) or (np.diff(times) <= 0).any() or times[0] < 0:
        problem = f"an animation of the file has {count} values at {len(times)} times, or its times do not rise"
        raise InputError(problem, remedy=_REMEDY, file=path)
    kinds = _ROTATION_KINDS if moved == "rotation" else _FLOATS
    values = reader.read(sampler.output, width, kinds).astype(np.float64)
    if moved == "rotation" and not (values[1::3] if cubic else values).any(1).all():
        raise InputError("an animation of the file has a rotation without direction", remedy=_REMEDY, file=path)
    return Curve(times, values.reshape(len(times), 3, width) if cubic else values, sampler.interpolation)
