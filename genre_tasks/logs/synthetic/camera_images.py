"""Pictures of the scene: rays through a lens, sun and sky, and the average over sub-pixel samples."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.materials import MIRROR, ROUGH, Material
from genre_tasks.logs.synthetic.mesh import linear
from genre_tasks.logs.synthetic.noise import Reals, dot3, fractal, rotated
from genre_tasks.logs.synthetic.raycast import Hits, Scene
from genre_tasks.logs.synthetic.road import generator
from genre_tasks.logs.synthetic.textures import albedo
from genre_tasks.logs.types import Float32, Float64, Lens

_BAND_RAYS = 1 << 16
_HAZE_M = 420.0
SHEEN_EXPONENT = 6
"""Of Phong's lobe: half as bright about 27° from the mirrored sun."""


@dataclass(frozen=True)
class Light:
    """Sun and sky of a seed. ``sun`` [3] unit towards it; colours are linear; ``clouds`` the share of them.

    ``gloss``: strength of the sheen that surfaces have of both.
    """

    sun: Float64
    sun_colour: Float32
    zenith: Float32
    horizon: Float32
    clouds: float
    drift: float
    exposure: float
    gloss: float = 0.0


def draw_light(seed: int, gloss: float = 0.0) -> Light:
    """Late morning to afternoon, clear to broken clouds."""
    rng = generator(seed, "light")
    height, azimuth = np.deg2rad(rng.uniform(28, 62)), rng.uniform(0, 2 * np.pi)
    sun = np.array([np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)])
    warm = 1 - (height - 0.49) / 0.6
    return Light(
        sun=sun,
        sun_colour=np.array([2.1, 1.97 - 0.2 * warm, 1.75 - 0.5 * warm], np.float32),
        zenith=linear((0.26, 0.45, 0.78)) * np.float32(rng.uniform(0.9, 1.2)),
        horizon=linear((0.74, 0.82, 0.90)),
        clouds=float(rng.uniform(0.30, 0.62)),
        drift=float(rng.uniform(0, 200)),
        exposure=float(rng.uniform(0.85, 1.0)),
        gloss=gloss,
    )


def sky(light: Light, direction: Reals) -> Reals:
    """[n, 3] linear radiance of the sky: a gradient, clouds and a glow around the sun."""
    up = np.clip(direction[:, 2], 0, 1)
    share = (1 - (1 - up) ** 3)[:, None]
    value = light.horizon * (1 - share) + light.zenith * share
    plane = direction[:, :2] / (up[:, None] + np.float32(0.18))
    drift = np.float32(light.drift)
    cover = fractal(plane[:, 0] * 1.4 + drift, plane[:, 1] * 1.4, 5, 40)
    cloud = np.clip((cover - np.float32(1 - light.clouds)) * 5, 0, 1) * np.clip(up * 6, 0, 1)
    white = np.float32(0.72) + np.float32(0.28) * (1 - cloud)
    value = value + (white[:, None] - value) * (cloud * np.float32(0.9))[:, None]
    glow = np.clip(dot3(direction, light.sun.astype(np.float32)), 0, 1) ** 40
    return value + glow[:, None] * np.float32(0.35)


def camera_rays(lens: Lens, samples: int, rows: slice = slice(None)) -> Float64:
    """[rows · W · samples, 3] unit directions in camera axes; samples of a pixel are neighbours, on a fixed grid."""
    side = round(samples**0.5)
    step = (np.arange(side) + 0.5) / side
    dx, dy = np.meshgrid(step, step)
    x = (np.arange(lens.width_px)[None, :, None] + dx.ravel() - lens.cx_px) / lens.fx_px
    y = (np.arange(lens.height_px)[rows, None, None] + dy.ravel() - lens.cy_px) / lens.fy_px
    x, y = np.broadcast_arrays(x, y)
    if any(lens.distortion):
        x, y = _undistorted(x, y, lens.distortion)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    return rays / np.sqrt(dot3(rays, rays))[:, None]


def _undistorted(x: Float64, y: Float64, distortion: tuple[float, ...]) -> tuple[Float64, Float64]:
    """Inverse of Brown–Conrady by fixed-point iteration (converges for the mild distortion of such lenses)."""
    k1, k2, p1, p2, k3 = (*distortion, *([0.0] * 5))[:5]
    u, v = x, y
    for _ in range(20):
        r = u * u + v * v
        radial = 1 + r * (k1 + r * (k2 + r * k3))
        du = 2 * p1 * u * v + p2 * (r + 2 * u * u)
        dv = p1 * (r + 2 * v * v) + 2 * p2 * u * v
        u, v = (x - du) / radial, (y - dv) / radial
    return u, v


def shade(
    scene: Scene, light: Light, hits: Hits, origin: Float64, direction: Reals, time: float, spread: float
) -> Reals:
    """[n, 3] linear radiance seen along rays; ``spread`` is the angle between neighbouring rays."""
    d = direction.astype(np.float32)
    out = sky(light, d) if (hits.face < 0).any() else np.zeros_like(d)
    pick = np.flatnonzero(hits.face >= 0)
    if len(pick) == 0:
        return out
    h = Hits(hits.distance_m[pick], hits.face[pick], hits.u[pick], hits.v[pick], hits.normal[pick])
    d, n, faces = d[pick], h.normal, scene.faces
    material = faces.material[h.face]
    slant = np.clip(-dot3(n, d), 0.05, 1)
    blur = h.distance_m * np.float32(spread) / np.sqrt(slant)
    base = albedo(material, scene.texture_points(h), faces.colour[h.face], faces.parameters[h.face], blur)

    points = origin.astype(np.float32) + d * h.distance_m[:, None]
    facing = dot3(n, light.sun.astype(np.float32))
    # Leaves let light through from behind.
    facing = np.where(material == Material.LEAF, 0.35 + 0.65 * np.abs(facing), facing)
    lit = np.flatnonzero(facing > 0)
    sunlight = np.zeros(len(pick), np.float32)
    dark = scene.shadowed(points[lit], n[lit], light.sun, time)
    sunlight[lit] = np.where(dark, 0, facing[lit])
    up = (0.5 + 0.5 * n[:, 2])[:, None]
    # Sky from above, and light thrown back by the street from below; the factors make shade about a third of sunlight.
    ambient: Reals = 0.62 * (0.6 * light.zenith + light.horizon) * up
    ambient = ambient + np.array([0.36, 0.33, 0.28], np.float32) * (1 - up)
    value: Reals = base * (sunlight[:, None] * light.sun_colour + ambient)
    value = np.where((material == Material.LAMP)[:, None], base, value)
    if light.gloss:
        value = value + _sheen(light, d, n, sunlight > 0, slant) * ROUGH[material][:, None]
    value = _mirrored(light, value, d, n, MIRROR[material], slant)
    haze = (1 - np.exp(-h.distance_m / np.float32(_HAZE_M)))[:, None]
    out[pick] = value + (light.horizon * np.float32(0.9) - value) * haze
    return out


def _sheen(light: Light, d: Reals, n: Reals, sunlit: NDArray[np.bool_], slant: Reals) -> Reals:
    """Sun and sky as a rough surface mirrors them: Phong's lobe, and Schlick's approximation towards grazing views."""
    r = d + 2 * slant[:, None] * n
    lobe = np.clip(dot3(r, light.sun.astype(np.float32)), 0, 1) ** SHEEN_EXPONENT * sunlit
    grazing = (1 - slant) ** 3 * np.clip(r[:, 2] + np.float32(0.5), 0, 1)
    bright = lobe[:, None] * light.sun_colour + grazing[:, None] * light.horizon
    return bright * np.float32(light.gloss)


def _mirrored(light: Light, value: Reals, d: Reals, n: Reals, share: Reals, slant: Reals) -> Reals:
    """Adds the sky's reflection to glass and paint (Schlick's approximation)."""
    pick = np.flatnonzero(share > 0)
    if len(pick) == 0:
        return value
    f = share[pick] + (1 - share[pick]) * (1 - slant[pick]) ** 5
    r = d[pick] - 2 * dot3(d[pick], n[pick])[:, None] * n[pick]
    seen = sky(light, r) * np.clip(r[:, 2] * 4 + 0.5, 0.12, 1)[:, None]
    value[pick] = value[pick] * (1 - f[:, None]) + seen * f[:, None]
    return value


def picture(
    scene: Scene, light: Light, time: float, world_SE3_camera: Float64, lens: Lens, samples: int
) -> NDArray[np.uint8]:
    """[H, W, 3] sRGB; the mean of ``samples`` rays a pixel, taken in linear light."""
    return to_srgb(radiance(scene, light, time, world_SE3_camera, lens, samples))


def radiance(
    scene: Scene,
    light: Light,
    time: float,
    world_SE3_camera: Float64,
    lens: Lens,
    samples: int,
    gain: Float32 | None = None,  # [3]
    rows: slice = slice(None),
) -> Float32:
    """Linear light of the chosen rows of an image, [rows, W, 3] in 0 to 1, times the light's exposure and ``gain``."""
    origin = world_SE3_camera[:3, 3]
    spread = 1.0 / (max(lens.fx_px, 1e-6) * samples**0.5)
    band = max(1, _BAND_RAYS // (lens.width_px * samples))
    start, stop, _ = rows.indices(lens.height_px)
    out = []
    for first in range(start, stop, band):
        rays = camera_rays(lens, samples, slice(first, min(first + band, stop)))
        d = rotated(world_SE3_camera[:3, :3], rays)
        value = shade(scene, light, scene.cast(origin, d, time), origin, d, time, spread) * np.float32(light.exposure)
        if gain is not None:
            value = value * gain
        # Bright samples are clipped first, so that an edge against the sky stays as smooth as a camera's.
        out.append(np.minimum(value, 1.0).reshape(-1, samples, 3).mean(1))
    return np.concatenate(out).reshape(stop - start, lens.width_px, 3)


def to_srgb(value: Reals) -> NDArray[np.uint8]:
    """Linear light to 8-bit sRGB (IEC 61966-2-1)."""
    v = np.clip(value.astype(np.float64), 0, 1)
    coded = np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055)
    return np.round(coded * 255).astype(np.uint8)
