"""Procedural textures: the albedo of a hit from its object coordinates, its face's colour and parameters.

Every texture is a function of ``SurfacePoints`` that returns [n, 3] linear albedo. It is deterministic: the same point
has the same colour in every image. Fine detail is box-filtered over the ray's footprint, or faded to its mean, so that
far detail does not flicker. On walls, texture coordinates are x along the wall, y its height and z into it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.ground_textures import grass_texture, kerb_texture, pavement_texture, road_texture
from genre_tasks.logs.synthetic.materials import (
    DARK,
    RIM,
    WHITE,
    Material,
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

Texture = Callable[[SurfacePoints], Reals]

# A face's random number times this prime is a whole number for the lattice: what is in its room.
_ROOM_SEEDS = 9973

_MAX_ALBEDO = 0.95


def _plain(points: SurfacePoints) -> Reals:
    x, y, z = points.coordinates.T
    spots = value_noise(x * 6 + z * 5, y * 6 + z * 3)
    return points.colour * vary_brightness(spots, 0.12, detail_weight(points.blur, 0.2))


def _brick(points: SurfacePoints) -> Reals:
    """Running bond of 0.30 × 0.10 m, each brick of its own tone; parameter 2 shifts the stains."""
    x, y, z = points.coordinates.T
    blur = points.blur
    row = np.floor(y / np.float32(0.10))
    # Every other row is offset by half a brick; z lets the bond run on into the reveals.
    along = x + np.float32(0.15) * (row % 2) + z
    tone = lattice_random(np.floor(along / np.float32(0.30)), row, 6)
    mortar = np.maximum(periodic_stripes(y, 0.10, 0.018, blur), periodic_stripes(along, 0.30, 0.018, blur))
    stains = fractal_noise(x * 0.5 + points.parameters[:, 2], y * 0.4, 2)
    value = points.colour * vary_brightness(tone, 0.34, detail_weight(blur, 0.2)) * vary_brightness(stains, 0.28)
    return mix(value, np.full(3, 0.42, np.float32), mortar * 0.7)


def _plaster(points: SurfacePoints) -> Reals:
    """Painted render: stains, vertical streaks, a little grain; parameter 2 shifts them."""
    x, y, z = points.coordinates.T
    along = x + z + points.parameters[:, 2]
    stains = fractal_noise(along * 0.45, y * 0.45, 3)
    # Rain draws streaks that are twelve times as high as they are wide.
    streaks = value_noise(along * 2.6, y * 0.22, 9)
    grain = value_noise(along * 11, y * 11, 10)
    return (
        points.colour
        * vary_brightness(stains, 0.22)
        * vary_brightness(streaks, 0.16)
        * vary_brightness(grain, 0.14, detail_weight(points.blur, 0.1))
    )


def _panel(points: SurfacePoints) -> Reals:
    """Stone or concrete panels of 1.2 × 0.6 m; parameter 2 shifts the stains."""
    x, y, z = points.coordinates.T
    blur = points.blur
    row = np.floor(y / np.float32(0.6))
    # Half a panel of offset, as with bricks.
    along = x + z + np.float32(0.6) * (row % 2)
    joints = np.maximum(periodic_stripes(along, 1.2, 0.03, blur), periodic_stripes(y, 0.6, 0.03, blur))
    tone = lattice_random(np.floor(along / np.float32(1.2)), row, 12)
    stains = fractal_noise((x + z) * 1.3 + points.parameters[:, 2], y * 1.3, 3)
    value = points.colour * vary_brightness(tone, 0.2, detail_weight(blur, 0.6)) * vary_brightness(stains, 0.2)
    return value * (1 - 0.55 * joints)[:, None]


def _wood(points: SurfacePoints) -> Reals:
    x, y, z = points.coordinates.T
    gap = periodic_stripes(x + y, 0.18, 0.02, points.blur)
    fibre = value_noise(x * 22, z * 1.5, 2)
    return points.colour * vary_brightness(fibre, 0.3, detail_weight(points.blur, 0.06)) * (1 - 0.5 * gap)[:, None]


def _bark(points: SurfacePoints) -> Reals:
    x, _, z = points.coordinates.T
    furrows = value_noise(x * 14, z * 3.5, 2)
    return points.colour * vary_brightness(furrows, 0.7, detail_weight(points.blur, 0.1))


def _leaf(points: SurfacePoints) -> Reals:
    """Parameter 0: the leaf's own brightness; parameter 1: how yellow it is."""
    ones = np.ones_like(points.blur)
    yellow = np.stack([ones * 1.35, ones, ones * 0.7], 1).astype(np.float32)
    # Leaves of one brightness would make the crown look flat.
    brightness = 0.55 + 0.9 * points.parameters[:, :1]
    return points.colour * brightness * (1 + (yellow - 1) * points.parameters[:, 1:2])


def _window(points: SurfacePoints) -> Reals:
    """A pane with a frame of the face's colour; parameters: width and height in metres, its room, its bars."""
    x = points.coordinates[:, 0]
    y = points.coordinates[:, 1]
    blur = points.blur
    width, height, room, bars = points.parameters.T
    edge = np.minimum(np.minimum(x, width - x), np.minimum(y, height - y))
    frame = np.clip((0.07 - edge) / (blur + 0.005) + 0.5, 0, 1)
    # Some windows have an upright bar, some of those a crossbar too.
    frame = np.maximum(frame, stripe(x - width / 2, 0, 0.06, blur) * (bars > 0.3))
    frame = np.maximum(frame, stripe(y - height * 0.62, 0, 0.06, blur) * (bars > 0.6))
    lamplight = (room * 0.05)[:, None] * np.array([1.2, 1, 0.7], np.float32)
    # Rooms are dark by day; the little light that comes back is warm.
    inside = np.full((len(x), 3), 0.02, np.float32) + lamplight
    room_seed = np.floor(room * _ROOM_SEEDS)
    folds = 0.75 + 0.25 * np.sin(x * 38 + room * 9) * detail_weight(blur, 0.15)
    # Curtains from both sides, as far as the room says; a third of the rooms have none.
    drawn = np.minimum(x, width - x) < (0.05 + 0.42 * lattice_random(room_seed, 3, 1)) * width
    tone = folds * (0.18 + 0.4 * lattice_random(room_seed, 5, 2))
    curtain = tone[:, None] * np.array([1, 0.96, 0.88], np.float32)
    inside = np.where((drawn & (room > 0.35))[:, None], curtain, inside)
    return mix(inside, points.colour, frame)


def _shop(points: SurfacePoints) -> Reals:
    """A shop window: dark room, shelves of coloured goods, a frame every 1.4 m; parameters as of a window."""
    x = points.coordinates[:, 0]
    y = points.coordinates[:, 1]
    blur = points.blur
    room_seed = np.floor(points.parameters[:, 2] * _ROOM_SEEDS)
    i = np.floor(x * 3.1)
    shelf = np.floor(y * 2.7) + room_seed
    # Squared, since most goods are dark and a few bright.
    goods = np.stack([lattice_random(i, shelf, 20 + channel) for channel in range(3)], 1) ** 2 * np.float32(0.5)
    # Four places in ten are empty and show the back of the shelf.
    is_taken = lattice_random(i, shelf, 24) < 0.6
    inside = np.where(is_taken[:, None], goods, np.float32(0.03)) * vary_brightness(value_noise(x * 9, y * 9), 0.5)
    frame = np.maximum(periodic_stripes(x, 1.4, 0.07, blur), stripe(y, 0.0, 0.16, blur))
    frame = np.maximum(frame, stripe(y - points.parameters[:, 1], 0.0, 0.16, blur))
    return mix(inside.astype(np.float32), points.colour, frame)


def _awning(points: SurfacePoints) -> Reals:
    return mix(points.colour, WHITE, periodic_stripes(points.coordinates[:, 0], 0.5, 0.25, points.blur))


def _car_paint(points: SurfacePoints) -> Reals:
    """Car paint with door gaps, a sill and dust towards the ground; parameter 2 shifts the dust."""
    x, y, z = points.coordinates.T
    blur = points.blur
    gaps = np.maximum(
        stripe(x, -0.35, 0.025, blur),
        np.maximum(stripe(x, 0.75, 0.025, blur), stripe(x, -1.25, 0.025, blur)),
    )
    gaps = gaps * ((z > 0.35) & (z < 0.92))
    sill = np.clip((0.33 - z) / 0.05, 0, 1)
    # Only the lower part gathers dust, in spots.
    dust = np.clip((0.75 - z) * 0.4, 0, 0.3) * fractal_noise(x * 2 + points.parameters[:, 2], y * 2 + z * 2, 2)
    value = mix(points.colour, np.full(3, 0.16, np.float32), dust)
    return mix(value, DARK * np.float32(0.4), np.maximum(gaps * 0.8, sill * 0.8))


def _tyre(points: SurfacePoints) -> Reals:
    """A spoked rim in a tyre; parameters: radius in metres, x and z of the hub."""
    radius, hub_x, hub_z, _ = points.parameters.T
    from_hub_x = points.coordinates[:, 0] - hub_x
    from_hub_z = points.coordinates[:, 2] - hub_z
    distance = np.hypot(from_hub_x, from_hub_z)
    rim = np.clip((radius * 0.64 - distance) / (points.blur + 0.005) + 0.5, 0, 1)
    # Five spokes; the gaps between them are dark, not black.
    spokes = 0.25 + 0.75 * (np.cos(5 * np.arctan2(from_hub_z, from_hub_x)) > -0.3)
    rubber = np.full((len(points.blur), 3), 0.015, np.float32)
    return mix(rubber, RIM * spokes[:, None].astype(np.float32), rim)


def _sign(points: SurfacePoints) -> Reals:
    """A traffic sign in local y, z; parameters: half size in metres, 0 round or 1 square, over 0.4: a symbol."""
    y = points.coordinates[:, 1]
    z = points.coordinates[:, 2]
    half, shape, symbol, _ = points.parameters.T
    edge = np.where(shape < 0.5, np.hypot(y, z), np.maximum(np.abs(y), np.abs(z))) / half
    value = mix(np.broadcast_to(WHITE, (len(y), 3)), points.colour, np.clip((edge - 0.78) / 0.06, 0, 1))
    bar = (np.abs(y) < half * 0.45) & (np.abs(z) < half * 0.16)
    # Square signs show a cross, round ones a bar.
    bar |= (shape > 0.5) & (np.abs(y) < half * 0.16) & (np.abs(z) < half * 0.5)
    return np.where((bar & (symbol > 0.4))[:, None], DARK, value)


def _cloth(points: SurfacePoints) -> Reals:
    """Parameter 0 over 0.5: striped."""
    x, y, z = points.coordinates.T
    value = points.colour * vary_brightness(value_noise(x * 9 + y * 9, z * 5), 0.4)
    is_striped = points.parameters[:, 0] > 0.5
    return value * (1 - 0.4 * periodic_stripes(z, 0.16, 0.05, points.blur) * is_striped)[:, None]


def _uniform(points: SurfacePoints) -> Reals:
    return points.colour


TEXTURES: dict[Material, Texture] = {
    Material.PLAIN: _plain,
    Material.ROAD: road_texture,
    Material.KERB: kerb_texture,
    Material.PAVEMENT: pavement_texture,
    Material.GRASS: grass_texture,
    Material.BRICK: _brick,
    Material.PLASTER: _plaster,
    Material.PANEL: _panel,
    Material.WOOD: _wood,
    Material.METAL: _plain,
    Material.BARK: _bark,
    Material.LEAF: _leaf,
    Material.WINDOW: _window,
    Material.SHOP: _shop,
    Material.AWNING: _awning,
    Material.PAINT: _car_paint,
    Material.CAR_GLASS: _uniform,
    Material.TYRE: _tyre,
    Material.LAMP: _uniform,
    Material.SIGN: _sign,
    Material.CLOTH: _cloth,
    Material.ROOF: _plain,
}


def evaluate_albedo(material: NDArray[np.uint8], points: SurfacePoints) -> Reals:
    """Evaluates the texture of each point's material.

    Args:
        material: [n] numbers of ``Material``.
        points: n points.

    Returns:
        [n, 3] linear albedo, float32, clipped to [0, 0.95].
    """
    albedo = np.zeros((len(points.coordinates), 3), np.float32)
    # Point by point, a texture depends on nothing but its own point, so the order of materials does not matter.
    for number in np.unique(material):
        indices = np.flatnonzero(material == number)
        albedo[indices] = TEXTURES[Material(int(number))](points.select(indices))
    # No surface sends back all light, and none more than it received.
    return np.clip(albedo, 0, _MAX_ALBEDO)
