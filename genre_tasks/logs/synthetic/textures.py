"""Procedural textures: the albedo of a hit from its object coordinates, its face's colour and parameters.

Every texture is a function ``(p, colour, free, blur) -> albedo`` with ``p`` [n, 3] texture coordinates in metres,
``colour`` [n, 3] linear, ``free`` [n, 4] the face's parameters and ``blur`` [n] the footprint of a ray in metres, over
which fine detail is box-filtered or faded to its mean so that far detail does not flicker.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np

from genre_tasks.logs.synthetic.mesh import linear
from genre_tasks.logs.synthetic.noise import cell, fractal, noise, seam, stripe
from genre_tasks.logs.types import Float32


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

_WHITE = linear((0.85, 0.85, 0.82))
_YELLOW = linear((0.85, 0.66, 0.18))
_DARK = linear((0.10, 0.11, 0.12))

Texture = Callable[[Float32, Float32, Float32, Float32], Float32]


def _mix(a: Float32, b: Float32, share: Float32) -> Float32:
    return a + (b - a) * share[:, None]


def _keep(blur: Float32, feature: float) -> Float32:
    """1 where a feature is resolved, 0 where it is not."""
    return np.clip(2 - 2 * blur / np.float32(feature), 0, 1)


def _wobble(value: Float32, amount: float, keep: Float32 | float = 1.0) -> Float32:
    """A factor around 1 from a random number in [0, 1]."""
    return (1 + np.float32(2 * amount) * (value - np.float32(0.5)) * keep)[:, None]


def plain(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    return colour * _wobble(noise(p[:, 0] * 6 + p[:, 2] * 5, p[:, 1] * 6 + p[:, 2] * 3), 0.12, _keep(blur, 0.2))


def road(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Asphalt with patches, cracks, wheel tracks, manholes; lane lines and zebra crossings (``free[3]``: where)."""
    s, t = p[:, 0], p[:, 1]
    grain = cell(np.floor(s * 28), np.floor(t * 28), 3)
    value = colour * _wobble(fractal(s * 0.35, t * 0.7, 3), 0.45) * _wobble(grain, 0.35, _keep(blur, 0.07))
    patch = cell(np.floor(s / 5.3), np.floor(t / 2.3), 5) < 0.10
    value = value * np.where(patch, np.float32(0.68), np.float32(1))[:, None]
    crack = stripe(noise(s * 0.7 + 9, t * 0.7, 7) + 0.25 * noise(s * 5, t * 5, 8), 0.62, 0.03, 0.02 + 0.5 * blur)
    value = value * (1 - 0.45 * crack * _keep(blur, 0.15))[:, None]
    lane = t - np.float32(3.5) * np.round(t / np.float32(3.5))
    value = value * (1 - 0.14 * np.exp(-(((np.abs(lane) - 0.8) / 0.3) ** 2)))[:, None]
    k = np.floor(s / 13)
    ds = s - 13 * (k + 0.2 + 0.6 * cell(k, 1, 11))
    radius = np.hypot(ds, t - (cell(k, 2, 11) * 7 - 4.5))
    value = _mix(value, _DARK * np.float32(1.5), np.clip((0.36 - radius) / (blur + 0.01) + 0.5, 0, 1) * 0.8)
    return _road_paint(s, t, value, free, blur)


def _road_paint(s: Float32, t: Float32, value: Float32, free: Float32, blur: Float32) -> Float32:
    worn = np.clip(noise(s * 2.3, t * 6, 13) * 2.4 + 0.1, 0, 1) * np.float32(0.9)
    dash = np.clip((1.5 - np.abs(s - 7 * np.round(s / 7))) / (blur + 0.02) + 0.5, 0, 1)
    wide = free[:, 2] > 1.5
    white = np.maximum(stripe(t, -1.75, 0.14, blur) * dash, stripe(t, 5.25, 0.14, blur) * dash * wide)
    white = np.maximum(white, stripe(t - free[:, 0], 2.45, 0.1, blur))
    white = np.maximum(white, stripe(t - free[:, 1], -2.45, 0.1, blur))
    yellow = np.maximum(stripe(t, 1.65, 0.11, blur), stripe(t, 1.89, 0.11, blur))
    along = s - free[:, 3]
    inside = np.abs(along) < 1.7
    bars = seam(t + 0.25, 1.0, 0.5, blur) * stripe(along, 0.0, 3.0, blur)
    stop = stripe(along, -3.2, 0.4, blur) * ((t < 1.5) & (t > free[:, 0] + 2.5))
    white = np.where(inside, bars, np.maximum(white, stop))
    yellow = np.where(inside, 0, yellow)
    value = _mix(value, _WHITE, white * worn)
    return _mix(value, _YELLOW, yellow * worn)


def kerb(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    value = (
        colour * _wobble(cell(np.floor(p[:, 0] / 1.0), 0, 2), 0.2) * _wobble(fractal(p[:, 0] * 4, p[:, 1] * 9, 2), 0.25)
    )
    return value * (1 - 0.5 * seam(p[:, 0], 1.0, 0.03, blur))[:, None]


def pavement(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Slabs of 0.75 m, each of its own grey, with joints and stains."""
    s, t = p[:, 0], p[:, 1]
    slab = cell(np.floor(s / 0.75), np.floor(t / 0.75), 4)
    joints = np.maximum(seam(s, 0.75, 0.03, blur), seam(t, 0.75, 0.03, blur))
    value = colour * _wobble(slab, 0.16, _keep(blur, 0.75)) * _wobble(fractal(s * 0.9, t * 0.9, 3, 6), 0.35)
    return value * (1 - 0.5 * joints)[:, None]


def grass(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    s, t = p[:, 0], p[:, 1]
    value = colour * _wobble(fractal(s * 0.3, t * 0.3, 2, 3), 0.5)
    return value * _wobble(fractal(s * 5, t * 5, 2, 5), 0.5, _keep(blur, 0.2))


def brick(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Running bond of 0.30 × 0.10 m, each brick of its own tone."""
    row = np.floor(p[:, 1] / np.float32(0.10))
    along = p[:, 0] + np.float32(0.15) * (row % 2) + p[:, 2]
    tone = cell(np.floor(along / np.float32(0.30)), row, 6)
    mortar = np.maximum(seam(p[:, 1], 0.10, 0.018, blur), seam(along, 0.30, 0.018, blur))
    value = (
        colour
        * _wobble(tone, 0.34, _keep(blur, 0.2))
        * _wobble(fractal(p[:, 0] * 0.5 + free[:, 2], p[:, 1] * 0.4, 2), 0.28)
    )
    return _mix(value, np.full(3, 0.42, np.float32) * np.float32(1), mortar * 0.7)


def plaster(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Painted render: stains, vertical streaks, a little grain."""
    x, z = p[:, 0] + p[:, 2] + free[:, 2], p[:, 1]
    streak = noise(x * 2.6, z * 0.22, 9)
    grain = noise(x * 11, z * 11, 10)
    return (
        colour
        * _wobble(fractal(x * 0.45, z * 0.45, 3), 0.22)
        * _wobble(streak, 0.16)
        * _wobble(grain, 0.14, _keep(blur, 0.1))
    )


def panel(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Stone or concrete panels of 1.2 × 0.6 m."""
    x, z = p[:, 0] + p[:, 2], p[:, 1]
    row = np.floor(z / np.float32(0.6))
    along = x + np.float32(0.6) * (row % 2)
    joints = np.maximum(seam(along, 1.2, 0.03, blur), seam(z, 0.6, 0.03, blur))
    tone = cell(np.floor(along / np.float32(1.2)), row, 12)
    value = colour * _wobble(tone, 0.2, _keep(blur, 0.6)) * _wobble(fractal(x * 1.3 + free[:, 2], z * 1.3, 3), 0.2)
    return value * (1 - 0.55 * joints)[:, None]


def wood(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    plank = seam(p[:, 0] + p[:, 1], 0.18, 0.02, blur)
    return colour * _wobble(noise(p[:, 0] * 22, p[:, 2] * 1.5, 2), 0.3, _keep(blur, 0.06)) * (1 - 0.5 * plank)[:, None]


def bark(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    return colour * _wobble(noise(p[:, 0] * 14, p[:, 2] * 3.5, 2), 0.7, _keep(blur, 0.1))


def leaf(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """``free[0]``: the leaf's own brightness; ``free[1]``: how yellow it is."""
    yellow = np.stack([np.ones_like(blur) * 1.35, np.ones_like(blur), np.ones_like(blur) * 0.7], 1).astype(np.float32)
    return colour * (0.55 + 0.9 * free[:, :1]) * (1 + (yellow - 1) * free[:, 1:2])


def window(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """A pane of ``free[:2]`` metres with a frame of the face's colour; ``free[2]`` its room, ``free[3]`` its bars."""
    x, z, w, h, room = p[:, 0], p[:, 1], free[:, 0], free[:, 1], free[:, 2]
    edge = np.minimum(np.minimum(x, w - x), np.minimum(z, h - z))
    frame = np.clip((0.07 - edge) / (blur + 0.005) + 0.5, 0, 1)
    frame = np.maximum(frame, stripe(x - w / 2, 0, 0.06, blur) * (free[:, 3] > 0.3))
    frame = np.maximum(frame, stripe(z - h * 0.62, 0, 0.06, blur) * (free[:, 3] > 0.6))
    inside = np.full((len(x), 3), 0.02, np.float32) + (room * 0.05)[:, None] * np.array([1.2, 1, 0.7], np.float32)
    folds = 0.75 + 0.25 * np.sin(x * 38 + room * 9) * _keep(blur, 0.15)
    drawn = np.minimum(x, w - x) < (0.05 + 0.42 * cell(np.floor(room * 9973), 3, 1)) * w
    curtain = (folds * (0.18 + 0.4 * cell(np.floor(room * 9973), 5, 2)))[:, None] * np.array(
        [1, 0.96, 0.88], np.float32
    )
    inside = np.where((drawn & (room > 0.35))[:, None], curtain, inside)
    return _mix(inside, colour, frame)


def shop(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """A shop window: dark room, shelves of coloured goods, a frame every 1.4 m."""
    x, z, room = p[:, 0], p[:, 1], np.floor(free[:, 2] * 9973)
    i, j = np.floor(x * 3.1), np.floor(z * 2.7)
    goods = np.stack([cell(i, j + room, 20 + k) for k in range(3)], 1) ** 2 * np.float32(0.5)
    shown = cell(i, j + room, 24) < 0.6
    inside = np.where(shown[:, None], goods, np.float32(0.03)) * _wobble(noise(x * 9, z * 9), 0.5)
    bars = np.maximum(seam(x, 1.4, 0.07, blur), stripe(z, 0.0, 0.16, blur))
    bars = np.maximum(bars, stripe(z - free[:, 1], 0.0, 0.16, blur))
    return _mix(inside.astype(np.float32), colour, bars)


def awning(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    return _mix(colour, _WHITE, seam(p[:, 0], 0.5, 0.25, blur))


def paint(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Car paint with door seams, a sill and dust towards the ground."""
    x, z = p[:, 0], p[:, 2]
    door = np.maximum(
        stripe(x, -0.35, 0.025, blur), np.maximum(stripe(x, 0.75, 0.025, blur), stripe(x, -1.25, 0.025, blur))
    )
    door = door * ((z > 0.35) & (z < 0.92))
    sill = np.clip((0.33 - z) / 0.05, 0, 1)
    dust = np.clip((0.75 - z) * 0.4, 0, 0.3) * fractal(x * 2 + free[:, 2], p[:, 1] * 2 + z * 2, 2)
    value = _mix(colour, np.full(3, 0.16, np.float32), dust)
    return _mix(value, _DARK * np.float32(0.4), np.maximum(door * 0.8, sill * 0.8))


def tyre(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """Rubber outside ``free[0]`` metres from the hub (``free[1]``, ``free[2]`` are its x and z), a spoked rim inside."""
    dx, dz = p[:, 0] - free[:, 1], p[:, 2] - free[:, 2]
    radius = np.hypot(dx, dz)
    rim = np.clip((free[:, 0] * 0.64 - radius) / (blur + 0.005) + 0.5, 0, 1)
    spokes = 0.25 + 0.75 * (np.cos(5 * np.arctan2(dz, dx)) > -0.3)
    return _mix(
        np.full((len(blur), 3), 0.015, np.float32), linear((0.68, 0.68, 0.7)) * spokes[:, None].astype(np.float32), rim
    )


def sign(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    """A traffic sign in local y, z with half size ``free[0]``: border and a symbol (``free[1]``)."""
    y, z, half, kind = p[:, 1], p[:, 2], free[:, 0], free[:, 1]
    edge = np.where(kind < 0.5, np.hypot(y, z), np.maximum(np.abs(y), np.abs(z))) / half
    value = _mix(np.broadcast_to(_WHITE, (len(y), 3)), colour, np.clip((edge - 0.78) / 0.06, 0, 1))
    bar = (np.abs(y) < half * 0.45) & (np.abs(z) < half * 0.16)
    bar |= (kind > 0.5) & (np.abs(y) < half * 0.16) & (np.abs(z) < half * 0.5)
    return np.where((bar & (free[:, 2] > 0.4))[:, None], _DARK, value)


def cloth(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    value = colour * _wobble(noise(p[:, 0] * 9 + p[:, 1] * 9, p[:, 2] * 5), 0.4)
    return value * (1 - 0.4 * seam(p[:, 2], 0.16, 0.05, blur) * (free[:, 0] > 0.5))[:, None]


def unaltered(p: Float32, colour: Float32, free: Float32, blur: Float32) -> Float32:
    return colour


TEXTURES: dict[Material, Texture] = {
    Material.PLAIN: plain,
    Material.ROAD: road,
    Material.KERB: kerb,
    Material.PAVEMENT: pavement,
    Material.GRASS: grass,
    Material.BRICK: brick,
    Material.PLASTER: plaster,
    Material.PANEL: panel,
    Material.WOOD: wood,
    Material.METAL: plain,
    Material.BARK: bark,
    Material.LEAF: leaf,
    Material.WINDOW: window,
    Material.SHOP: shop,
    Material.AWNING: awning,
    Material.PAINT: paint,
    Material.CAR_GLASS: unaltered,
    Material.TYRE: tyre,
    Material.LAMP: unaltered,
    Material.SIGN: sign,
    Material.CLOTH: cloth,
    Material.ROOF: plain,
}


def albedo(
    material: Float32,  # [n] material numbers
    p: Float32,  # [n, 3]
    colour: Float32,  # [n, 3]
    free: Float32,  # [n, 4]
    blur: Float32,  # [n]
) -> Float32:
    """[n, 3] linear albedo, clipped to [0, 0.95]."""
    out = np.zeros((len(p), 3), np.float32)
    for kind in np.unique(material):
        pick = np.flatnonzero(material == kind)
        out[pick] = TEXTURES[Material(int(kind))](p[pick], colour[pick], free[pick], blur[pick])
    return np.clip(out, 0, 0.95)
