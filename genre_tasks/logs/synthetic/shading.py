"""Light on the street: sun, sky and shadows, sheen and mirrors, haze."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.materials import MIRROR, SHEEN, Material, SurfacePoints
from genre_tasks.logs.synthetic.noise import Reals, dot_rows, fractal_noise
from genre_tasks.logs.synthetic.raycast import RayCaster
from genre_tasks.logs.synthetic.road import make_generator
from genre_tasks.logs.synthetic.textures import evaluate_albedo
from genre_tasks.logs.types import Float32, Float64
from genre_tasks.srgb import srgb_to_linear

# After so many metres, two thirds of what arrives is haze.
_HAZE_M = 420.0
# Of Phong's lobe: half as bright about 27° from the mirrored sun.
_SHEEN_EXPONENT = 6

# At grazing views the footprint would grow without bound.
_MIN_SLANT = 0.05


@dataclass(frozen=True)
class Light:
    """Sun and sky of a street.

    Attributes:
        sun: [3] unit vector towards it, in the street's coordinates.
        sun_colour: [3] linear.
        zenith: [3] linear colour of the sky overhead.
        horizon: [3] linear colour of the sky at the horizon, and of haze.
        clouds: share of the sky that they cover, roughly.
        drift: moves the clouds.
        exposure: factor of every image.
        sheen: strength of the sheen of both on rough surfaces; 0: none.
    """

    sun: Float64
    sun_colour: Float32
    zenith: Float32
    horizon: Float32
    clouds: float
    drift: float
    exposure: float
    sheen: float = 0.0


def draw_light(seed: int, sheen: float = 0.0) -> Light:
    """Draws the light of late morning to afternoon, clear to broken clouds.

    Args:
        seed: of the street.
        sheen: strength of the sheen.

    Returns:
        The light.

    >>> 0.3 <= draw_light(7).clouds <= 0.62
    True
    """
    rng = make_generator(seed, "light")
    height = np.deg2rad(rng.uniform(28, 62))
    azimuth = rng.uniform(0, 2 * np.pi)
    # 1 for a low sun, which is redder.
    warmth = 1 - (height - 0.49) / 0.6
    return Light(
        sun=np.array([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)]),
        sun_colour=np.array([2.1, 1.97 - 0.2 * warmth, 1.75 - 0.5 * warmth], np.float32),
        zenith=srgb_to_linear((0.26, 0.45, 0.78)).astype(np.float32) * np.float32(rng.uniform(0.9, 1.2)),
        horizon=srgb_to_linear((0.74, 0.82, 0.90)).astype(np.float32),
        clouds=float(rng.uniform(0.30, 0.62)),
        drift=float(rng.uniform(0, 200)),
        exposure=float(rng.uniform(0.85, 1.0)),
        sheen=sheen,
    )


def sky_radiance(light: Light, direction: Reals) -> Reals:
    """Evaluates the sky: a gradient, clouds and a glow around the sun.

    Args:
        light: of the street.
        direction: [n, 3] unit vectors, away from the viewer.

    Returns:
        [n, 3] linear radiance.
    """
    up = np.clip(direction[:, 2], 0, 1)
    # The sky darkens quickly above the horizon and then hardly at all.
    zenith_share = (1 - (1 - up) ** 3)[:, None]
    value = light.horizon * (1 - zenith_share) + light.zenith * zenith_share
    # Clouds lie on a plane overhead; the offset keeps them from shrinking to nothing at the horizon.
    plane = direction[:, :2] / (up[:, None] + np.float32(0.18))
    drift = np.float32(light.drift)
    cover = fractal_noise(plane[:, 0] * 1.4 + drift, plane[:, 1] * 1.4, 5, 40)
    cloud = np.clip((cover - np.float32(1 - light.clouds)) * 5, 0, 1) * np.clip(up * 6, 0, 1)
    white = np.float32(0.72) + np.float32(0.28) * (1 - cloud)
    value = value + (white[:, None] - value) * (cloud * np.float32(0.9))[:, None]
    glow = np.clip(dot_rows(direction, light.sun.astype(np.float32)), 0, 1) ** 40
    return value + glow[:, None] * np.float32(0.35)


def shade_rays(
    caster: RayCaster,
    light: Light,
    origin: Float64,  # [3]
    direction: Reals,  # [n, 3]
    *,
    time: float,
    ray_angle: float,
) -> Reals:
    """Casts rays and evaluates the light that comes back along them.

    Args:
        caster: the street.
        light: sun and sky.
        origin: [3] of all rays, metres.
        direction: [n, 3] unit vectors.
        time: seconds since the first frame.
        ray_angle: radians between neighbouring rays, which sets how fine the detail of a texture is.

    Returns:
        [n, 3] linear radiance.
    """
    all_hits = caster.cast(origin, direction, time)
    directions = direction.astype(np.float32)
    # Clouds are costly, and many bands of an image show no sky.
    has_sky = bool((all_hits.face < 0).any())
    radiance = sky_radiance(light, directions) if has_sky else np.zeros_like(directions)
    on_face = np.flatnonzero(all_hits.face >= 0)
    if len(on_face) == 0:
        return radiance
    hits = all_hits.select(on_face)
    directions = directions[on_face]
    normal = hits.normal
    faces = caster.faces
    material = faces.material[hits.face]
    slant = np.clip(-dot_rows(normal, directions), _MIN_SLANT, 1)
    points = SurfacePoints(
        coordinates=caster.texture_coordinates(hits),
        colour=faces.colour[hits.face],
        parameters=faces.parameters[hits.face],
        # A ray's footprint on the face; the root, since it grows along one of two directions only.
        blur=hits.distance_m * np.float32(ray_angle) / np.sqrt(slant),
    )
    albedo = evaluate_albedo(material, points)
    positions = origin.astype(np.float32) + directions * hits.distance_m[:, None]
    sunlight = _sunlight(caster, light, material, positions, normal, time)
    value: Reals = albedo * (sunlight[:, None] * light.sun_colour + _ambient_light(light, normal))
    # Lamps glow by themselves.
    value = np.where((material == Material.LAMP)[:, None], albedo, value)
    # The default has none, and is spared the time.
    if light.sheen:
        reflected = _sheen_radiance(light, directions, normal, sunlight > 0, slant)
        value = value + reflected * SHEEN[material][:, None]
    value = _add_mirrored_sky(value, light, directions, normal, MIRROR[material], slant)
    # Haze takes the horizon's colour, so that the far end of the street fades into the sky.
    haze = (1 - np.exp(-hits.distance_m / np.float32(_HAZE_M)))[:, None]
    radiance[on_face] = value + (light.horizon * np.float32(0.9) - value) * haze
    return radiance


def _sunlight(
    caster: RayCaster,
    light: Light,
    material: NDArray[np.uint8],  # [n]
    positions: Float32,  # [n, 3]
    normal: Float32,  # [n, 3]
    time: float,
) -> Float32:
    """[n] cosine between normals and sun, 0 in the shadow."""
    facing = dot_rows(normal, light.sun.astype(np.float32))
    # Leaves let light through from behind.
    facing = np.where(material == Material.LEAF, 0.35 + 0.65 * np.abs(facing), facing)
    towards_sun = np.flatnonzero(facing > 0)
    sunlight = np.zeros(len(positions), np.float32)
    is_dark = caster.find_shadowed(positions[towards_sun], normal[towards_sun], light.sun, time)
    sunlight[towards_sun] = np.where(is_dark, 0, facing[towards_sun])
    return sunlight


def _ambient_light(light: Light, normal: Float32) -> Reals:
    """[n, 3] sky from above, and light thrown back by the street from below."""
    up = (0.5 + 0.5 * normal[:, 2])[:, None]
    # The factors make shade about a third of sunlight.
    ambient: Reals = 0.62 * (0.6 * light.zenith + light.horizon) * up
    return ambient + np.array([0.36, 0.33, 0.28], np.float32) * (1 - up)


def _sheen_radiance(
    light: Light,
    direction: Reals,  # [n, 3]
    normal: Reals,  # [n, 3]
    is_sunlit: NDArray[np.bool_],  # [n]
    slant: Reals,  # [n]
) -> Reals:
    """[n, 3] sun and sky as a rough surface mirrors them: Phong's lobe, and Schlick's rise towards grazing views."""
    mirrored = direction + 2 * slant[:, None] * normal
    lobe = np.clip(dot_rows(mirrored, light.sun.astype(np.float32)), 0, 1) ** _SHEEN_EXPONENT * is_sunlit
    grazing = (1 - slant) ** 3 * np.clip(mirrored[:, 2] + np.float32(0.5), 0, 1)
    radiance = lobe[:, None] * light.sun_colour + grazing[:, None] * light.horizon
    return radiance * np.float32(light.sheen)


def _add_mirrored_sky(
    value: Reals,  # [n, 3], changed in place
    light: Light,
    direction: Reals,  # [n, 3]
    normal: Reals,  # [n, 3]
    mirror: Reals,  # [n]
    slant: Reals,  # [n]
) -> Reals:
    """Adds the sky's reflection to glass and paint (Schlick's approximation)."""
    pick = np.flatnonzero(mirror > 0)
    if len(pick) == 0:
        return value
    share = mirror[pick] + (1 - mirror[pick]) * (1 - slant[pick]) ** 5
    cosine = dot_rows(direction[pick], normal[pick])
    mirrored = direction[pick] - 2 * cosine[:, None] * normal[pick]
    # Rays that go down meet the street, which is darker than the sky.
    darkening = np.clip(mirrored[:, 2] * 4 + 0.5, 0.12, 1)
    sky = sky_radiance(light, mirrored) * darkening[:, None]
    value[pick] = value[pick] * (1 - share[:, None]) + sky * share[:, None]
    return value
