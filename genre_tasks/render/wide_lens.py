"""Images of f-theta and fisheye lenses: those of pinholes that cover the view, resampled along the lens's rays.

The renderer projects through pinholes. A lens whose pixels lie at a polynomial of the angle from its axis sees the same
rays in other places.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.logs.types import Float32, Float64, Lens

MAX_ANGLE_RAD = np.radians(120.0)
"""Of a ray from the axis: no pinhole looks backwards."""

_SAMPLES = 4096
_MARGIN_PX = 2
_SMALLEST = 1e-9
_MAX_FOCAL_PX = 1e6
_SHORTEST_PART = 0.4

# Ahead, to the left and right, up and down: columns are x, y and z of a pinhole in the axes of the wide lens.
_SIDES = tuple(
    np.array(columns, np.float64).T
    for columns in (
        ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
        ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
        ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
        ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
        ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    )
)


@dataclass(frozen=True)
class WideLens:
    """A lens of which r, the distance from the principal point, is a function of θ, the angle from the axis.

    A ray at the azimuth φ appears at ``center_px + matrix @ (r cos φ, r sin φ)``.

    Attributes:
        width_px: width of the image that the lens is stated for.
        height_px: height of that image.
        center_px: principal point, pixels from the upper left corner.
        matrix: 2 × 2, row by row.
        angle_to_radius: coefficients of r by rising powers of θ; empty where ``radius_to_angle`` is stated.
        radius_to_angle: coefficients of θ by rising powers of r.
        max_angle_rad: rays farther from the axis are black; 0: not stated.
    """

    width_px: int
    height_px: int
    center_px: tuple[float, float]
    matrix: tuple[float, float, float, float]
    angle_to_radius: tuple[float, ...] = ()
    radius_to_angle: tuple[float, ...] = ()
    max_angle_rad: float = 0.0

    def find_rays(self, width_px: int, height_px: int) -> tuple[Float64, Float64, NDArray[np.bool_]]:
        """Finds the rays that arrive at the pixels of an image.

        Args:
            width_px: of the image, which shows the lens's whole view.
            height_px: of the image.

        Returns:
            Angles θ from the axis [H, W], azimuths φ [H, W], and where any ray arrives [H, W].

        >>> fisheye = WideLens(200, 200, (100.0, 100.0), (50.0, 0.0, 0.0, 50.0), angle_to_radius=(0.0, 1.0))
        >>> angle, azimuth, arrives = fisheye.find_rays(2, 2)
        >>> angle.round(4).tolist()[0], bool(arrives.all())
        ([1.4142, 1.4142], True)
        """
        u = (np.arange(width_px) + 0.5) * (self.width_px / width_px) - self.center_px[0]
        v = (np.arange(height_px) + 0.5) * (self.height_px / height_px) - self.center_px[1]
        a, b, c, d = self.matrix
        determinant = a * d - b * c
        if abs(determinant) < 1e-12 * max(abs(value) for value in self.matrix) ** 2 or not any(self.matrix):
            raise InputError("the lens maps all rays onto a line", remedy="Give focal lengths above 0.")
        x = (d * u[None, :] - b * v[:, None]) / determinant
        y = (a * v[:, None] - c * u[None, :]) / determinant
        angle, arrives = self._find_angles(np.hypot(x, y))
        return angle, np.arctan2(y, x), arrives

    def _find_angles(self, radius: Float64) -> tuple[Float64, NDArray[np.bool_]]:
        limit = min(self.max_angle_rad or np.pi, np.pi)
        # Absurd coefficients overflow, and then rise nowhere.
        with np.errstate(over="ignore", invalid="ignore"):
            if self.radius_to_angle:
                radii = np.linspace(0.0, max(float(radius.max()), _SMALLEST), _SAMPLES)
                angles = np.asarray(polyval(radii, self.radius_to_angle), np.float64)
            else:
                angles = np.linspace(0.0, limit, _SAMPLES)
                radii = np.asarray(polyval(angles, self.angle_to_radius), np.float64)
            # Past the first place where a polynomial turns back no ray of the lens is.
            rising = (np.diff(angles) > 0) & (np.diff(radii) > 0)
        count = _SAMPLES if rising.all() else int(np.argmin(rising)) + 1
        if count < 2:
            raise InputError("the lens's polynomial does not rise from its axis", remedy="Give that of a real lens.")
        angle = np.interp(radius, radii[:count], angles[:count])
        return angle, (radius <= radii[count - 1]) & (angle <= limit)

    def measure_focal_px(self, width_px: int, height_px: int) -> float:
        """Measures how many pixels a radian at the axis has.

        Args:
            width_px: of the image.
            height_px: of the image.

        Returns:
            The larger number of both directions.

        Raises:
            InputError: the lens has no such number.
        """
        a, b, c, d = self.matrix
        scale = max(np.hypot(a, b) * width_px / self.width_px, np.hypot(c, d) * height_px / self.height_px)
        coefficients = self.angle_to_radius or self.radius_to_angle
        slope = coefficients[1] if len(coefficients) > 1 else 0.0
        focal = scale * slope if self.angle_to_radius else scale / max(slope, _SMALLEST)
        if not 0 < focal <= _MAX_FOCAL_PX:
            raise InputError(f"the lens has {focal:g} pixels a radian", remedy="Give the polynomial of a real lens.")
        return float(focal)


@dataclass(frozen=True)
class CoverTile:
    """A pinhole whose image covers a part of a wide lens's rays, and where in it they are.

    Attributes:
        lens: the pinhole.
        lens_R_tile: [3, 3] takes the pinhole's axes to those of the wide lens.
        pixels: [N] the wide lens's pixels that the tile covers, counted row by row.
        columns: [N] where their rays are in the tile, as indices of columns.
        rows: [N] the same for rows.
        first_row: the uppermost row of the wide lens's image that the tile covers, as a part of its height.
        last_row: the lower edge of the lowest such row.
    """

    lens: Lens
    lens_R_tile: Float64
    pixels: NDArray[np.int64]
    columns: Float32
    rows: Float32
    first_row: float
    last_row: float


@dataclass(frozen=True)
class LensCover:
    """Pinholes whose images cover the view of a wide lens.

    Attributes:
        width_px: of the wide lens's image.
        height_px: of the wide lens's image.
        tiles: the pinholes, one to five.
    """

    width_px: int
    height_px: int
    tiles: tuple[CoverTile, ...]

    def resample(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
        """Makes the wide lens's image.

        Args:
            images: [H', W', 3] of each tile.

        Returns:
            [H, W, 3]; black where no ray arrives.
        """
        out = np.zeros((self.height_px * self.width_px, 3), np.uint8)
        for tile, image in zip(self.tiles, images, strict=True):
            places = np.stack([tile.rows, tile.columns])
            for channel in range(3):
                values = map_coordinates(image[..., channel].astype(np.float32), places, order=1, mode="nearest")
                out[tile.pixels, channel] = np.rint(values).astype(np.uint8)
        return out.reshape(self.height_px, self.width_px, 3)


def cover_lens(lens: WideLens, width_px: int, height_px: int) -> LensCover:
    """Finds pinholes, as sharp as a wide lens at its axis, that cover its view.

    They look along the sides of a cube: Gaussians that a pinhole sees at more than some 55° from its axis are drawn too
    large, as their projection is linearised.

    Args:
        lens: wide.
        width_px: of the wide lens's image.
        height_px: of the wide lens's image.

    Returns:
        The pinholes.

    Raises:
        ConfigError: the view is wider than ``MAX_ANGLE_RAD`` from the axis.
        InputError: the lens is none: no ray arrives, or its polynomial does not rise.

    >>> fisheye = WideLens(200, 120, (100.0, 60.0), (100.0, 0.0, 0.0, 100.0), angle_to_radius=(0.0, 1.0))
    >>> [tile.lens.fx_px for tile in cover_lens(fisheye, 100, 60).tiles]
    [50.0, 50.0, 50.0]
    """
    angle, azimuth, arrives = lens.find_rays(width_px, height_px)
    if not arrives.any():
        raise InputError("no ray of the lens is in the image", remedy="Give a principal point within the image.")
    widest = float(angle[arrives].max())
    if widest > MAX_ANGLE_RAD:
        raise ConfigError(
            f"the lens sees {np.degrees(widest):.0f}° from its axis, and {np.degrees(MAX_ANGLE_RAD):.0f}° are rendered",
            remedy="Give a narrower lens, or a smaller max_angle.",
        )
    focal = lens.measure_focal_px(width_px, height_px)
    pixels = np.flatnonzero(arrives)
    radial = np.sin(angle.ravel()[pixels])
    turn = azimuth.ravel()[pixels]
    rays = np.stack([radial * np.cos(turn), radial * np.sin(turn), np.cos(angle.ravel()[pixels])], 1)
    # Along the axis of each side, the largest component decides.
    nearest = np.stack([rays @ rotation[:, 2] for rotation in _SIDES]).argmax(0)
    tiles = []
    for side, rotation in enumerate(_SIDES):
        chosen = np.flatnonzero(nearest == side)
        if len(chosen):
            rows = pixels[chosen] // width_px
            span = (int(rows.min()) / height_px, (int(rows.max()) + 1) / height_px)
            tiles.append(_place_tile(rays[chosen] @ rotation, rotation, pixels[chosen], focal, span))
    return LensCover(width_px, height_px, tuple(tiles))


def _place_tile(
    rays: Float64, rotation: Float64, pixels: NDArray[np.int64], focal: float, span: tuple[float, float]
) -> CoverTile:
    """The smallest pinhole for rays [N, 3] in its axes."""
    x = focal * rays[:, 0] / rays[:, 2]
    y = focal * rays[:, 1] / rays[:, 2]
    left, width = _find_extent(x)
    top, height = _find_extent(y)
    pinhole = Lens(focal, focal, cx_px=float(left), cy_px=float(top), width_px=width, height_px=height)
    return CoverTile(
        lens=pinhole,
        lens_R_tile=rotation,
        pixels=pixels,
        # Indices count from the centre of the first pixel.
        columns=(x + left - 0.5).astype(np.float32),
        rows=(y + top - 0.5).astype(np.float32),
        first_row=span[0],
        last_row=span[1],
    )


def _find_extent(values: Float64) -> tuple[int, int]:
    """Where the axis is in an image that just holds some places, and how long the image is."""
    low = int(np.floor(values.min())) - _MARGIN_PX
    high = int(np.ceil(values.max())) + _MARGIN_PX
    # A thin strip far from its axis is no image that a renderer takes.
    shortest = int(np.ceil(_SHORTEST_PART * max(abs(low), abs(high))))
    if high - low < shortest:
        low, high = (high - shortest, high) if high > 0 else (low, low + shortest)
    return -low, high - low


def fisheye_polynomial(coefficients: Sequence[float]) -> tuple[float, ...]:
    """Gives the polynomial of OpenCV's fisheye: θ + k1 θ³ + k2 θ⁵ + k3 θ⁷ + k4 θ⁹.

    Args:
        coefficients: k1 to k4; fewer count as 0.

    >>> fisheye_polynomial((0.5,))
    (0.0, 1.0, 0.0, 0.5)
    """
    values = [0.0, 1.0]
    for coefficient in coefficients:
        values += [0.0, float(coefficient)]
    return tuple(values)
