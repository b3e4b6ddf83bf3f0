"""What faces are made of, how that mirrors and reflects a laser, and the helpers that textures share."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.noise import Reals
from genre_tasks.logs.types import Float32
from genre_tasks.srgb import srgb_to_linear


class Material(IntEnum):
    """What a face is made of."""

    PLAIN = 0
    ROAD = 1
    KERB = 2
    PAVEMENT = 3
    GRASS = 4
    BRICK = 5
    PLASTER = 6
    PANEL = 7
    WOOD = 8
    METAL = 9
    BARK = 10
    LEAF = 11
    WINDOW = 12
    SHOP = 13
    AWNING = 14
    PAINT = 15
    CAR_GLASS = 16
    TYRE = 17
    LAMP = 18
    SIGN = 19
    CLOTH = 20
    ROOF = 21


# Rough values for a laser of 905 nm: signs throw it back to the sensor, tyres and glass hardly do.
_REFLECTIVITY: dict[Material, float] = {
    Material.PLAIN: 0.4,
    Material.ROAD: 0.15,
    Material.KERB: 0.3,
    Material.PAVEMENT: 0.25,
    Material.GRASS: 0.35,
    Material.BRICK: 0.3,
    Material.PLASTER: 0.5,
    Material.PANEL: 0.4,
    Material.WOOD: 0.35,
    Material.METAL: 0.5,
    Material.BARK: 0.2,
    Material.LEAF: 0.4,
    Material.WINDOW: 0.12,
    Material.SHOP: 0.15,
    Material.AWNING: 0.4,
    Material.PAINT: 0.55,
    Material.CAR_GLASS: 0.1,
    Material.TYRE: 0.05,
    Material.LAMP: 0.7,
    Material.SIGN: 0.95,
    Material.CLOTH: 0.3,
    Material.ROOF: 0.2,
}
# [materials] LiDAR reflectivity at normal incidence, in [0, 1].
REFLECTIVITY = np.array([_REFLECTIVITY[material] for material in Material], np.float32)

# [materials] share of light that is mirrored at normal incidence.
MIRROR = np.zeros(len(Material), np.float32)
MIRROR[[Material.WINDOW, Material.SHOP, Material.CAR_GLASS]] = 0.10
# Clear coat reflects as any dielectric does; panes have two surfaces.
MIRROR[Material.PAINT] = 0.04

# [materials] share of the street's sheen that shows: smooth glass mirrors instead, and a lamp glows by itself.
SHEEN = np.ones(len(Material), np.float32)
SHEEN[[Material.WINDOW, Material.SHOP, Material.CAR_GLASS, Material.LAMP]] = 0.0
SHEEN[[Material.GRASS, Material.LEAF, Material.BARK, Material.CLOTH]] = 0.3


def _to_linear(red: float, green: float, blue: float) -> Float32:
    return srgb_to_linear((red, green, blue)).astype(np.float32)


WHITE = _to_linear(0.85, 0.85, 0.82)
YELLOW = _to_linear(0.85, 0.66, 0.18)
DARK = _to_linear(0.10, 0.11, 0.12)
RIM = _to_linear(0.68, 0.68, 0.7)


@dataclass(frozen=True)
class SurfacePoints:
    """Points at which a texture is evaluated.

    Attributes:
        coordinates: [n, 3] texture coordinates, metres.
        colour: [n, 3] linear base colour of the face.
        parameters: [n, 4] texture parameters of the face.
        blur: [n] footprint of the ray, metres; detail finer than that is filtered.
    """

    coordinates: Reals
    colour: Reals
    parameters: Reals
    blur: Reals

    def select(self, indices: NDArray[np.int64]) -> SurfacePoints:
        """Picks some of the points.

        Args:
            indices: [m].

        Returns:
            m points.
        """
        return SurfacePoints(
            self.coordinates[indices],
            self.colour[indices],
            self.parameters[indices],
            self.blur[indices],
        )


def mix(a: Reals, b: Reals, share: Reals) -> Reals:
    """Blends colours.

    Args:
        a: [n, 3] or [3].
        b: [n, 3] or [3].
        share: [n] of b, in [0, 1].

    Returns:
        [n, 3].
    """
    # One product fewer than the weighted sum of both.
    return a + (b - a) * share[:, None]


def detail_weight(blur: Reals, feature: float) -> Reals:
    """Says how far detail of a size can be told apart; textures fade it to its mean below that.

    Args:
        blur: [n] footprint of a ray, metres.
        feature: size of the detail, metres.

    Returns:
        [n] 1 where the feature is resolved, 0 where it is smaller than the footprint.

    >>> detail_weight(np.array([0.25, 0.75, 2.0]), 1.0)
    array([1. , 0.5, 0. ])
    """
    return np.clip(2 - 2 * blur / np.float32(feature), 0, 1)


def vary_brightness(value: Reals, amount: float, weight: Reals | float = 1.0) -> Reals:
    """Turns a random number into a factor for a colour, 1 on average.

    Args:
        value: [n] in [0, 1].
        amount: largest difference of the factor from 1.
        weight: [n] of the difference, such as ``detail_weight``.

    Returns:
        [n, 1] factor.

    >>> vary_brightness(np.array([0.0, 0.5, 1.0]), 0.2).T
    array([[0.8, 1. , 1.2]])
    """
    return (1 + np.float32(2 * amount) * (value - np.float32(0.5)) * weight)[:, None]
