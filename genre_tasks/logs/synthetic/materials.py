"""What faces are made of, how that mirrors and reflects a laser, and the helpers that textures share."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from genre_tasks.logs.synthetic.mesh import linear
from genre_tasks.logs.synthetic.noise import Reals


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


# LiDAR reflectivity (0…1) and mirror share at normal incidence of each material, by number.
REFLECTIVITY = np.array(
    [
        0.4,
        0.15,
        0.3,
        0.25,
        0.35,
        0.3,
        0.5,
        0.4,
        0.35,
        0.5,
        0.2,
        0.4,
        0.12,
        0.15,
        0.4,
        0.55,
        0.1,
        0.05,
        0.7,
        0.95,
        0.3,
        0.2,
    ],
    np.float32,
)
MIRROR = np.zeros(len(Material), np.float32)
MIRROR[[Material.WINDOW, Material.SHOP, Material.CAR_GLASS]] = 0.10
MIRROR[Material.PAINT] = 0.04

# What share of a street's gloss a material shows: what mirrors has its own, and a lamp shines.
ROUGH = np.ones(len(Material), np.float32)
ROUGH[[Material.WINDOW, Material.SHOP, Material.CAR_GLASS, Material.LAMP]] = 0.0
ROUGH[[Material.GRASS, Material.LEAF, Material.BARK, Material.CLOTH]] = 0.3

WHITE = linear((0.85, 0.85, 0.82))
YELLOW = linear((0.85, 0.66, 0.18))
DARK = linear((0.10, 0.11, 0.12))


def mix(a: Reals, b: Reals, share: Reals) -> Reals:
    return a + (b - a) * share[:, None]


def resolved(blur: Reals, feature: float) -> Reals:
    """1 where a feature is resolved, 0 where it is not."""
    return np.clip(2 - 2 * blur / np.float32(feature), 0, 1)


def wobble(value: Reals, amount: float, keep: Reals | float = 1.0) -> Reals:
    """A factor around 1 from a random number in [0, 1]."""
    return (1 + np.float32(2 * amount) * (value - np.float32(0.5)) * keep)[:, None]
