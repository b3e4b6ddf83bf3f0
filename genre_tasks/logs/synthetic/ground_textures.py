"""Textures of the ground: road and its markings, kerbs, pavements, grass.

Texture coordinates are street coordinates: s metres along the street, t metres to the left of the ego lane's centre.
See ``textures`` for the signature.
"""

from __future__ import annotations

import numpy as np

from genre_tasks.logs.synthetic.materials import (
    DARK,
    WHITE,
    YELLOW,
    SurfacePoints,
    detail_weight,
    mix,
    vary_brightness,
)
from genre_tasks.logs.synthetic.noise import (
    Reals,
    fractal_noise,
    lattice_random,
    periodic_stripes,
    stripe,
    value_noise,
)

_LANE_M = np.float32(3.5)
_SLAB_M = 0.75


def road_texture(points: SurfacePoints) -> Reals:
    """Paints asphalt with patches, cracks, wheel tracks and manholes, and the markings on it.

    Args:
        points: n points; parameters: t of the right kerb, t of the left kerb, oncoming lanes, s of the nearest
            zebra crossing.

    Returns:
        [n, 3] linear albedo.
    """
    s = points.coordinates[:, 0]
    t = points.coordinates[:, 1]
    blur = points.blur
    # Grains of 3.6 cm, which fade where a ray covers 7 cm.
    grain = lattice_random(np.floor(s * 28), np.floor(t * 28), 3)
    stains = fractal_noise(s * 0.35, t * 0.7, 3)
    value: Reals = (
        points.colour * vary_brightness(stains, 0.45) * vary_brightness(grain, 0.35, detail_weight(blur, 0.07))
    )
    # One in ten rectangles of 5.3 × 2.3 m was repaired with darker asphalt.
    is_patch = lattice_random(np.floor(s / 5.3), np.floor(t / 2.3), 5) < 0.10
    value = value * np.where(is_patch, np.float32(0.68), np.float32(1))[:, None]
    # The contour of a smooth field is a curve that neither ends nor crosses itself: a crack.
    crack_line = value_noise(s * 0.7 + 9, t * 0.7, 7) + 0.25 * value_noise(s * 5, t * 5, 8)
    crack = stripe(crack_line, 0.62, 0.03, 0.02 + 0.5 * blur)
    value = value * (1 - 0.45 * crack * detail_weight(blur, 0.15))[:, None]
    # Tyres polish two tracks into every lane, 0.8 m to either side of its centre.
    from_lane_centre = t - _LANE_M * np.round(t / _LANE_M)
    value = value * (1 - 0.14 * np.exp(-(((np.abs(from_lane_centre) - 0.8) / 0.3) ** 2)))[:, None]
    # One manhole every 13 m, somewhere across the road.
    k = np.floor(s / 13)
    from_manhole = s - 13 * (k + 0.2 + 0.6 * lattice_random(k, 1, 11))
    radius = np.hypot(from_manhole, t - (lattice_random(k, 2, 11) * 7 - 4.5))
    value = mix(value, DARK * np.float32(1.5), np.clip((0.36 - radius) / (blur + 0.01) + 0.5, 0, 1) * 0.8)
    return _paint_markings(value, points)


def _paint_markings(asphalt: Reals, points: SurfacePoints) -> Reals:
    """Lane lines, zebra crossings with their stop line, and the yellow double line; [n, 3]."""
    s = points.coordinates[:, 0]
    t = points.coordinates[:, 1]
    blur = points.blur
    right_kerb, left_kerb, oncoming_lanes, crossing = points.parameters.T
    wear = np.clip(value_noise(s * 2.3, t * 6, 13) * 2.4 + 0.1, 0, 1) * np.float32(0.9)
    # Dashes of 3 m, one every 7 m.
    dash = np.clip((1.5 - np.abs(s - 7 * np.round(s / 7))) / (blur + 0.02) + 0.5, 0, 1)
    is_wide = oncoming_lanes > 1.5
    white = np.maximum(stripe(t, -1.75, 0.14, blur) * dash, stripe(t, 5.25, 0.14, blur) * dash * is_wide)
    # Edges of the parking lanes, 2.45 m from the kerbs.
    white = np.maximum(white, stripe(t - right_kerb, 2.45, 0.1, blur))
    white = np.maximum(white, stripe(t - left_kerb, -2.45, 0.1, blur))
    yellow = np.maximum(stripe(t, 1.65, 0.11, blur), stripe(t, 1.89, 0.11, blur))
    from_crossing = s - crossing
    on_crossing = np.abs(from_crossing) < 1.7
    bars = periodic_stripes(t + 0.25, 1.0, 0.5, blur) * stripe(from_crossing, 0.0, 3.0, blur)
    # Only in the lanes that drive towards the crossing.
    stop_line = stripe(from_crossing, -3.2, 0.4, blur) * ((t < 1.5) & (t > right_kerb + 2.5))
    # No other marking runs across a zebra crossing.
    white = np.where(on_crossing, bars, np.maximum(white, stop_line))
    yellow = np.where(on_crossing, 0, yellow)
    return mix(mix(asphalt, WHITE, white * wear), YELLOW, yellow * wear)


def kerb_texture(points: SurfacePoints) -> Reals:
    """Paints kerb stones of 1 m.

    Args:
        points: n points; no parameters.

    Returns:
        [n, 3] linear albedo.
    """
    s = points.coordinates[:, 0]
    t = points.coordinates[:, 1]
    tone = lattice_random(np.floor(s / 1.0), 0, 2)
    stains = fractal_noise(s * 4, t * 9, 2)
    value = points.colour * vary_brightness(tone, 0.2) * vary_brightness(stains, 0.25)
    return value * (1 - 0.5 * periodic_stripes(s, 1.0, 0.03, points.blur))[:, None]


def pavement_texture(points: SurfacePoints) -> Reals:
    """Paints slabs of 0.75 m, each of its own grey, with joints and stains.

    Args:
        points: n points; no parameters.

    Returns:
        [n, 3] linear albedo.
    """
    s = points.coordinates[:, 0]
    t = points.coordinates[:, 1]
    blur = points.blur
    tone = lattice_random(np.floor(s / _SLAB_M), np.floor(t / _SLAB_M), 4)
    stains = fractal_noise(s * 0.9, t * 0.9, 3, 6)
    joints = np.maximum(periodic_stripes(s, _SLAB_M, 0.03, blur), periodic_stripes(t, _SLAB_M, 0.03, blur))
    value = points.colour * vary_brightness(tone, 0.16, detail_weight(blur, _SLAB_M)) * vary_brightness(stains, 0.35)
    return value * (1 - 0.5 * joints)[:, None]


def grass_texture(points: SurfacePoints) -> Reals:
    """Paints grass, in spots of 3 m and of 0.2 m.

    Args:
        points: n points; no parameters.

    Returns:
        [n, 3] linear albedo.
    """
    s = points.coordinates[:, 0]
    t = points.coordinates[:, 1]
    value = points.colour * vary_brightness(fractal_noise(s * 0.3, t * 0.3, 2, 3), 0.5)
    return value * vary_brightness(fractal_noise(s * 5, t * 5, 2, 5), 0.5, detail_weight(points.blur, 0.2))
