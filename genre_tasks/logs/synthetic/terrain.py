"""Textures of the ground: road and its markings, kerbs, pavements, grass (see ``textures`` for the signature)."""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.materials import DARK, WHITE, YELLOW, mix, resolved, wobble
from genre_tasks.logs.synthetic.noise import Reals, cell, fractal, noise, seam, stripe


def road(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """Asphalt with patches, cracks, wheel tracks, manholes; lane lines and zebra crossings (``free[3]``: where)."""
    s, t = p[:, 0], p[:, 1]
    grain = cell(np.floor(s * 28), np.floor(t * 28), 3)
    value: Reals = colour * wobble(fractal(s * 0.35, t * 0.7, 3), 0.45) * wobble(grain, 0.35, resolved(blur, 0.07))
    patch = cell(np.floor(s / 5.3), np.floor(t / 2.3), 5) < 0.10
    value = value * np.where(patch, np.float32(0.68), np.float32(1))[:, None]
    crack = stripe(noise(s * 0.7 + 9, t * 0.7, 7) + 0.25 * noise(s * 5, t * 5, 8), 0.62, 0.03, 0.02 + 0.5 * blur)
    value = value * (1 - 0.45 * crack * resolved(blur, 0.15))[:, None]
    lane = t - np.float32(3.5) * np.round(t / np.float32(3.5))
    value = value * (1 - 0.14 * np.exp(-(((np.abs(lane) - 0.8) / 0.3) ** 2)))[:, None]
    k = np.floor(s / 13)
    ds = s - 13 * (k + 0.2 + 0.6 * cell(k, 1, 11))
    radius = np.hypot(ds, t - (cell(k, 2, 11) * 7 - 4.5))
    value = mix(value, DARK * np.float32(1.5), np.clip((0.36 - radius) / (blur + 0.01) + 0.5, 0, 1) * 0.8)
    return _road_paint(s, t, value, free, blur)


def _road_paint(s: Reals, t: Reals, value: Reals, free: Reals, blur: Reals) -> Reals:
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
    value = mix(value, WHITE, white * worn)
    return mix(value, YELLOW, yellow * worn)


def kerb(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    value = (
        colour * wobble(cell(np.floor(p[:, 0] / 1.0), 0, 2), 0.2) * wobble(fractal(p[:, 0] * 4, p[:, 1] * 9, 2), 0.25)
    )
    return value * (1 - 0.5 * seam(p[:, 0], 1.0, 0.03, blur))[:, None]


def pavement(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    """Slabs of 0.75 m, each of its own grey, with joints and stains."""
    s, t = p[:, 0], p[:, 1]
    slab = cell(np.floor(s / 0.75), np.floor(t / 0.75), 4)
    joints = np.maximum(seam(s, 0.75, 0.03, blur), seam(t, 0.75, 0.03, blur))
    value = colour * wobble(slab, 0.16, resolved(blur, 0.75)) * wobble(fractal(s * 0.9, t * 0.9, 3, 6), 0.35)
    return value * (1 - 0.5 * joints)[:, None]


def grass(p: Reals, colour: Reals, free: Reals, blur: Reals) -> Reals:
    s, t = p[:, 0], p[:, 1]
    value = colour * wobble(fractal(s * 0.3, t * 0.3, 2, 3), 0.5)
    return value * wobble(fractal(s * 5, t * 5, 2, 5), 0.5, resolved(blur, 0.2))
