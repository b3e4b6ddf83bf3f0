"""Gaussians as the integers of SPZ, in SPZ's axes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import logits_to_opacities, opacities_to_logits
from genre_tasks.exchange.types import SH_REST_COUNTS, SplatCloud
from genre_tasks.logs.types import Float32, Float64

MOST_FRACTIONAL_BITS = 12
"""Positions are no finer than in other writers' files: a quarter of a millimetre."""

# 24 bits with a sign.
_LARGEST_POSITION = (1 << 23) - 1
_POSITION_BITS = 24
_SCALE_OFFSET = 10.0
_SCALE_STEPS = 16.0
_COLOR_STEPS = 0.15 * 255.0
_COLOR_OFFSET = 127.5
_SH_STEPS = 128.0
_LARGEST_BYTE = 255
# Three parts of a rotation: a sign and nine bits each, up to the largest value that the second largest part can have.
_ROTATION_BITS = 9
_LARGEST_ROTATION = (1 << _ROTATION_BITS) - 1
_ROTATION_STEPS = _LARGEST_ROTATION * np.sqrt(2.0)
_FIRST_THREE_STEPS = 127.5
_REMEDY = "Leave out what is so far away or so large, or choose ply or glb, which hold any number."

ROTATION_BYTES = {1: 3, 2: 3, 3: 4, 4: 4}
"""Bytes of a rotation by the file's version."""

POSITION_BYTES = {1: 6, 2: 9, 3: 9, 4: 9}
"""Bytes of a position by the file's version; version 1 has half floats."""

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class QuantizedCloud:
    """N Gaussians as the bytes of a file.

    Attributes:
        version: 1 to 4, which tells how positions and rotations are stored.
        fractional_bits: of positions.
        antialiased: whether the file says so.
        positions: [N, 6 or 9].
        opacities: [N, 1].
        colors: [N, 3].
        scales: [N, 3].
        rotations: [N, 3 or 4].
        sh_rest: [N, 3 K]; K in ``SH_REST_COUNTS``.
    """

    version: int
    fractional_bits: int
    antialiased: bool
    positions: Bytes
    opacities: Bytes
    colors: Bytes
    scales: Bytes
    rotations: Bytes
    sh_rest: Bytes

    def streams(self) -> tuple[Bytes, ...]:
        """The attributes in the order of a file; harmonics are the last."""
        return (self.positions, self.opacities, self.colors, self.scales, self.rotations, self.sh_rest)


@dataclass(frozen=True)
class ClippedValues:
    """How many values of a cloud lie outside of what SPZ can hold, and are written as the nearest that it can.

    Attributes:
        colors: coefficients of the constant harmonic.
        sh_rest: further coefficients.
        small_scales: standard deviations below the smallest one, 45 micrometres.
    """

    colors: int
    sh_rest: int
    small_scales: int


def count_clipped(cloud: SplatCloud) -> ClippedValues:
    """Counts the values that are written as the nearest one that SPZ can hold.

    Args:
        cloud: N Gaussians in SPZ's axes: harmonics change with them.
    """
    return ClippedValues(
        colors=_count_outside(_scale_color(cloud.sh_dc)),
        sh_rest=_count_outside(_scale_sh(cloud.sh_rest)),
        small_scales=int((np.rint(_scale_size(cloud.log_scales)) < 0).sum()),
    )


def _count_outside(values: Float32 | Float64) -> int:
    rounded = np.rint(values)
    return int(((rounded < 0) | (rounded > _LARGEST_BYTE)).sum())


def choose_fractional_bits(path: Path, means: Float32) -> int:
    """Chooses how finely positions are stored: as finely as the scene's extent allows.

    Args:
        path: of the file, for the error.
        means: [N, 3] metres.

    Returns:
        0 to ``MOST_FRACTIONAL_BITS``; a position is rounded to 2^−bits metres.

    Raises:
        InputError: a mean is farther away than 24 bits can hold at all.

    >>> choose_fractional_bits(Path("scene.spz"), np.array([[5000.0, 0.0, 0.0]], np.float32))
    10
    """
    extent = float(np.abs(means).max(initial=0.0))
    for bits in range(MOST_FRACTIONAL_BITS, -1, -1):
        if np.rint(extent * 2.0**bits) <= _LARGEST_POSITION:
            return bits
    raise InputError(f"a Gaussian lies {extent:.0f} m from the origin, too far for SPZ", remedy=_REMEDY, file=path)


def quantize_cloud(path: Path, cloud: SplatCloud) -> QuantizedCloud:
    """Rounds a cloud to the integers of SPZ 4.

    Args:
        path: of the file, for errors.
        cloud: N Gaussians in SPZ's axes, finite.

    Returns:
        The integers. Positions are within half a step of 2^−bits metres, standard deviations within 1/32 of their
        logarithm, opacities within 1/510, harmonics within 1/256, each where it is in range; colours and harmonics
        outside of the range become its nearest value, as SPZ defines it.

    Raises:
        InputError: a Gaussian is too far away or too large, or its quaternion has no direction.
    """
    bits = choose_fractional_bits(path, cloud.means)
    scales = np.rint(_scale_size(cloud.log_scales))
    if (scales > _LARGEST_BYTE).any():
        size_m = float(np.exp(cloud.log_scales.max().astype(np.float64)))
        problem = f"a Gaussian has a standard deviation of {size_m:.0f} m, too large for SPZ"
        raise InputError(problem, remedy=_REMEDY, file=path)
    return QuantizedCloud(
        version=4,
        fractional_bits=bits,
        antialiased=bool(cloud.antialiased),
        positions=_pack_positions(cloud.means, bits),
        opacities=_round_to_bytes(logits_to_opacities(cloud.logit_opacities) * _LARGEST_BYTE)[:, None],
        colors=_round_to_bytes(_scale_color(cloud.sh_dc)),
        scales=_round_to_bytes(scales),
        rotations=_pack_rotations(path, cloud.quats),
        sh_rest=_round_to_bytes(_scale_sh(cloud.sh_rest)).reshape(len(cloud), 3 * SH_REST_COUNTS[cloud.sh_degree]),
    )


def restore_cloud(quantized: QuantizedCloud) -> SplatCloud:
    """Turns the integers of SPZ back into Gaussians: the inverse of :func:`quantize_cloud`, and for older versions.

    Args:
        quantized: of version 1 to 4.

    Returns:
        The Gaussians in SPZ's axes; positions of version 1 may be infinite or NaN, as in the file.
    """
    count = len(quantized.positions)
    if quantized.version == 1:
        means = quantized.positions.view("<f2").astype(np.float32)
    else:
        means = _unpack_positions(quantized.positions, quantized.fractional_bits)
    unpack_rotations = _unpack_first_three if quantized.version < 3 else _unpack_smallest_three
    return SplatCloud(
        means=means,
        log_scales=quantized.scales.astype(np.float32) / np.float32(_SCALE_STEPS) - np.float32(_SCALE_OFFSET),
        quats=unpack_rotations(quantized.rotations),
        logit_opacities=opacities_to_logits(quantized.opacities[:, 0] / _LARGEST_BYTE),
        sh_dc=((quantized.colors.astype(np.float64) - _COLOR_OFFSET) / _COLOR_STEPS).astype(np.float32),
        sh_rest=((quantized.sh_rest.astype(np.float32) - np.float32(_SH_STEPS)) / np.float32(_SH_STEPS)).reshape(
            count, quantized.sh_rest.shape[1] // 3, 3
        ),
        antialiased=quantized.antialiased,
    )


def _scale_size(log_scales: Float32) -> Float64:
    return (log_scales.astype(np.float64) + _SCALE_OFFSET) * _SCALE_STEPS


def _scale_color(sh_dc: Float32) -> Float64:
    return sh_dc.astype(np.float64) * _COLOR_STEPS + _COLOR_OFFSET


def _scale_sh(sh_rest: Float32) -> Float32:
    # In float32, since harmonics are most of a file: a step is many orders above its rounding.
    return sh_rest * np.float32(_SH_STEPS) + np.float32(_SH_STEPS)


def _round_to_bytes(values: Float32 | Float64) -> Bytes:
    return np.clip(np.rint(values), 0, _LARGEST_BYTE).astype(np.uint8)


def _pack_positions(means: Float32, bits: int) -> Bytes:
    fixed = np.ascontiguousarray(np.rint(means.astype(np.float64) * 2.0**bits).astype("<i4"))
    # The low three bytes of four hold a number of 24 bits with its sign.
    return np.ascontiguousarray(fixed.view(np.uint8).reshape(len(means), 3, 4)[:, :, :3]).reshape(len(means), 9)


def _unpack_positions(positions: Bytes, bits: int) -> Float32:
    wide = np.zeros((len(positions), 3, 4), np.uint8)
    wide[:, :, 1:] = positions.reshape(-1, 3, 3)
    # In the high bytes the sign is where it belongs; shifting down then repeats it.
    fixed = wide.view("<i4")[:, :, 0] >> 8
    return np.asarray(fixed * 2.0**-bits, np.float32)


def _pack_rotations(path: Path, quats: Float32) -> Bytes:
    """The largest part's place in two bits, and the other three with a sign and nine bits, in the order x, y, z, w."""
    wide = quats.astype(np.float64)
    norms = np.linalg.norm(wide, axis=1, keepdims=True)
    if not norms.all():
        first = int(np.flatnonzero(norms == 0)[0])
        problem = f"the quaternion of Gaussian {first} (from 0 on) has no direction"
        raise InputError(problem, remedy="Leave this Gaussian out, or give it a rotation.", file=path)
    unit = np.roll(wide / norms, -1, axis=1)
    largest = np.abs(unit).argmax(1)
    # A quaternion and its negative are one rotation: with the largest part positive its sign needs no bit.
    unit *= np.where(np.take_along_axis(unit, largest[:, None], 1) < 0, -1.0, 1.0)
    word = largest.astype(np.uint32)
    for k in range(4):
        size = np.minimum(np.floor(np.abs(unit[:, k]) * _ROTATION_STEPS + 0.5), _LARGEST_ROTATION).astype(np.uint32)
        part = size | ((unit[:, k] < 0).astype(np.uint32) << _ROTATION_BITS)
        word = np.where(largest == k, word, (word << (_ROTATION_BITS + 1)) | part).astype(np.uint32)
    return word.astype("<u4").view(np.uint8).reshape(-1, 4)


def _unpack_smallest_three(rotations: Bytes) -> Float32:
    word = np.ascontiguousarray(rotations).view("<u4")[:, 0].astype(np.uint32)
    largest = word >> 30
    unit = np.zeros((len(word), 4))
    for k in (3, 2, 1, 0):
        stored = largest != k
        size = (word & _LARGEST_ROTATION) / _ROTATION_STEPS
        value = np.where((word >> _ROTATION_BITS) & 1, -size, size)
        unit[:, k] = np.where(stored, value, 0.0)
        word = np.where(stored, word >> (_ROTATION_BITS + 1), word)
    rest = np.sqrt(np.maximum(1 - (unit * unit).sum(1), 0.0))
    np.put_along_axis(unit, largest[:, None].astype(np.int64), rest[:, None], 1)
    return np.roll(unit, 1, axis=1).astype(np.float32)


def _unpack_first_three(rotations: Bytes) -> Float32:
    vector = rotations / _FIRST_THREE_STEPS - 1
    real = np.sqrt(np.maximum(1 - (vector * vector).sum(1, keepdims=True), 0.0))
    return np.concatenate([real, vector], 1).astype(np.float32)
