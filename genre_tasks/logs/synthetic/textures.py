"""Procedural textures: the albedo of a hit from its object coordinates, its face's colour and parameters.

Every texture is a function ``(p, colour, free, blur) -> albedo`` with ``p`` [n, 3] texture coordinates in metres,
``colour`` [n, 3] linear, ``free`` [n, 4] the face's parameters and ``blur`` [n] the footprint of a ray in metres, over
which fine detail is box-filtered or faded to its mean so that far detail does not flicker.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.materials import DARK, WHITE, Material, mix, resolved, wobble
from genre_tasks.logs.synthetic.mesh import linear
from genre_tasks.logs.synthetic.noise import Reals, cell, fractal, noise, seam, stripe
from genre_tasks.logs.synthetic.terrain import grass, kerb, pavement, road

Texture = Callable[[Reals, Reals, Reals, Reals], Reals]


def plain(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    return colour * wobble(noise(p[:, 0] * 6 + p[:, 2] * 5, p[:, 1] * 6 + p[:, 2] * 3), 0.12, resolved(blur, 0.2))


def brick(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """Running bond of 0.30 × 0.10 m, each brick of its own tone."""
    row = np.floor(p[:, 1] / np.float32(0.10))
    along = p[:, 0] + np.float32(0.15) * (row % 2) + p[:, 2]
    tone = cell(np.floor(along / np.float32(0.30)), row, 6)
    mortar = np.maximum(seam(p[:, 1], 0.10, 0.018, blur), seam(along, 0.30, 0.018, blur))
    value = (
        colour
        * wobble(tone, 0.34, resolved(blur, 0.2))
        * wobble(fractal(p[:, 0] * 0.5 + free[:, 2], p[:, 1] * 0.4, 2), 0.28)
    )
    return mix(value, np.full(3, 0.42, np.float32) * np.float32(1), mortar * 0.7)


def plaster(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """Painted render: stains, vertical streaks, a little grain."""
    x, z = p[:, 0] + p[:, 2] + free[:, 2], p[:, 1]
    streak = noise(x * 2.6, z * 0.22, 9)
    grain = noise(x * 11, z * 11, 10)
    return (
        colour
        * wobble(fractal(x * 0.45, z * 0.45, 3), 0.22)
        * wobble(streak, 0.16)
        * wobble(grain, 0.14, resolved(blur, 0.1))
    )


def panel(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """Stone or concrete panels of 1.2 × 0.6 m."""
    x, z = p[:, 0] + p[:, 2], p[:, 1]
    row = np.floor(z / np.float32(0.6))
    along = x + np.float32(0.6) * (row % 2)
    joints = np.maximum(seam(along, 1.2, 0.03, blur), seam(z, 0.6, 0.03, blur))
    tone = cell(np.floor(along / np.float32(1.2)), row, 12)
    value = colour * wobble(tone, 0.2, resolved(blur, 0.6)) * wobble(fractal(x * 1.3 + free[:, 2], z * 1.3, 3), 0.2)
    return value * (1 - 0.55 * joints)[:, None]


def wood(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    plank = seam(p[:, 0] + p[:, 1], 0.18, 0.02, blur)
    fibre = noise(p[:, 0] * 22, p[:, 2] * 1.5, 2)
    return colour * wobble(fibre, 0.3, resolved(blur, 0.06)) * (1 - 0.5 * plank)[:, None]


def bark(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    return colour * wobble(noise(p[:, 0] * 14, p[:, 2] * 3.5, 2), 0.7, resolved(blur, 0.1))


def leaf(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """``free[0]``: the leaf's own brightness; ``free[1]``: how yellow it is."""
    yellow = np.stack([np.ones_like(blur) * 1.35, np.ones_like(blur), np.ones_like(blur) * 0.7], 1).astype(np.float32)
    return colour * (0.55 + 0.9 * free[:, :1]) * (1 + (yellow - 1) * free[:, 1:2])


def window(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """A pane of ``free[:2]`` metres with a frame of the face's colour; ``free[2]`` its room, ``free[3]`` its bars."""
    x, z, w, h, room = p[:, 0], p[:, 1], free[:, 0], free[:, 1], free[:, 2]
    edge = np.minimum(np.minimum(x, w - x), np.minimum(z, h - z))
    frame = np.clip((0.07 - edge) / (blur + 0.005) + 0.5, 0, 1)
    frame = np.maximum(frame, stripe(x - w / 2, 0, 0.06, blur) * (free[:, 3] > 0.3))
    frame = np.maximum(frame, stripe(z - h * 0.62, 0, 0.06, blur) * (free[:, 3] > 0.6))
    inside = np.full((len(x), 3), 0.02, np.float32) + (room * 0.05)[:, None] * np.array([1.2, 1, 0.7], np.float32)
    folds = 0.75 + 0.25 * np.sin(x * 38 + room * 9) * resolved(blur, 0.15)
    drawn = np.minimum(x, w - x) < (0.05 + 0.42 * cell(np.floor(room * 9973), 3, 1)) * w
    curtain = (folds * (0.18 + 0.4 * cell(np.floor(room * 9973), 5, 2)))[:, None] * np.array(
        [1, 0.96, 0.88], np.float32
    )
    inside = np.where((drawn & (room > 0.35))[:, None], curtain, inside)
    return mix(inside, colour, frame)


def shop(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """A shop window: dark room, shelves of coloured goods, a frame every 1.4 m."""
    x, z, room = p[:, 0], p[:, 1], np.floor(free[:, 2] * 9973)
    i, j = np.floor(x * 3.1), np.floor(z * 2.7)
    goods = np.stack([cell(i, j + room, 20 + k) for k in range(3)], 1) ** 2 * np.float32(0.5)
    shown = cell(i, j + room, 24) < 0.6
    inside = np.where(shown[:, None], goods, np.float32(0.03)) * wobble(noise(x * 9, z * 9), 0.5)
    bars = np.maximum(seam(x, 1.4, 0.07, blur), stripe(z, 0.0, 0.16, blur))
    bars = np.maximum(bars, stripe(z - free[:, 1], 0.0, 0.16, blur))
    return mix(inside.astype(np.float32), colour, bars)


def awning(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    return mix(colour, WHITE, seam(p[:, 0], 0.5, 0.25, blur))


def paint(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """Car paint with door seams, a sill and dust towards the ground."""
    x, z = p[:, 0], p[:, 2]
    door = np.maximum(
        stripe(x, -0.35, 0.025, blur), np.maximum(stripe(x, 0.75, 0.025, blur), stripe(x, -1.25, 0.025, blur))
    )
    door = door * ((z > 0.35) & (z < 0.92))
    sill = np.clip((0.33 - z) / 0.05, 0, 1)
    dust = np.clip((0.75 - z) * 0.4, 0, 0.3) * fractal(x * 2 + free[:, 2], p[:, 1] * 2 + z * 2, 2)
    value = mix(colour, np.full(3, 0.16, np.float32), dust)
    return mix(value, DARK * np.float32(0.4), np.maximum(door * 0.8, sill * 0.8))


def tyre(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """A spoked rim in a tyre of radius ``free[0]`` metres; ``free[1]``, ``free[2]`` are the hub's x and z."""
    dx, dz = p[:, 0] - free[:, 1], p[:, 2] - free[:, 2]
    radius = np.hypot(dx, dz)
    rim = np.clip((free[:, 0] * 0.64 - radius) / (blur + 0.005) + 0.5, 0, 1)
    spokes = 0.25 + 0.75 * (np.cos(5 * np.arctan2(dz, dx)) > -0.3)
    return mix(
        np.full((len(blur), 3), 0.015, np.float32), linear((0.68, 0.68, 0.7)) * spokes[:, None].astype(np.float32), rim
    )


def sign(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """A traffic sign in local y, z with half size ``free[0]``: border and a symbol (``free[1]``)."""
    y, z, half, kind = p[:, 1], p[:, 2], free[:, 0], free[:, 1]
    edge = np.where(kind < 0.5, np.hypot(y, z), np.maximum(np.abs(y), np.abs(z))) / half
    value = mix(np.broadcast_to(WHITE, (len(y), 3)), colour, np.clip((edge - 0.78) / 0.06, 0, 1))
    bar = (np.abs(y) < half * 0.45) & (np.abs(z) < half * 0.16)
    bar |= (kind > 0.5) & (np.abs(y) < half * 0.16) & (np.abs(z) < half * 0.5)
    return np.where((bar & (free[:, 2] > 0.4))[:, None], DARK, value)


def cloth(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    value = colour * wobble(noise(p[:, 0] * 9 + p[:, 1] * 9, p[:, 2] * 5), 0.4)
    return value * (1 - 0.4 * seam(p[:, 2], 0.16, 0.05, blur) * (free[:, 0] > 0.5))[:, None]


def unaltered(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
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
    material: NDArray[np.uint8],  # [n] material numbers
    p: Reals,  # [n, 3]
    colour: Reals,  # [n, 3]
    free: Reals,  # [n, 4]
    blur: Reals,  # [n]
) -> Reals:
    """[n, 3] linear albedo, clipped to [0, 0.95]."""
    out = np.zeros((len(p), 3), np.float32)
    for kind in np.unique(material):
        pick = np.flatnonzero(material == kind)
        out[pick] = TEXTURES[Material(int(kind))](p[pick], colour[pick], free[pick], blur[pick])
    return np.clip(out, 0, 0.95)
