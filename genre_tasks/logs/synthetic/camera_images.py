"""Images of the street: rays through a lens, averaged over sub-pixel samples.

Pixels count from the image's upper left corner: the centre of the first one is (0.5, 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.noise import Reals, dot_rows, rotate
from genre_tasks.logs.synthetic.raycast import RayCaster
from genre_tasks.logs.synthetic.shading import Light, shade_rays
from genre_tasks.logs.types import Float32, Float64, Lens
from genre_tasks.srgb import linear_to_srgb

# Bounds the memory of an image, whatever its size.
_RAYS_AT_ONCE = 1 << 16
_UNDISTORTION_STEPS = 20
ALL_ROWS = slice(None)


@dataclass(frozen=True)
class Renderer:
    """Renders images of one street.

    Attributes:
        caster: the street.
        light: its sun and sky.
        samples: rays per pixel, a square number.
    """

    caster: RayCaster
    light: Light
    samples: int

    def render_srgb(self, time: float, street_SE3_camera: Float64, lens: Lens) -> NDArray[np.uint8]:
        """Renders an image.

        Args:
            time: seconds since the first frame.
            street_SE3_camera: [4, 4] pose of the camera, in the street's coordinates.
            lens: of the camera; its size is the image's.

        Returns:
            [H, W, 3] sRGB; the mean of the samples is taken in linear light.
        """
        return encode_srgb(self.render_linear(time, street_SE3_camera, lens))

    def render_linear(
        self,
        time: float,
        street_SE3_camera: Float64,  # [4, 4]
        lens: Lens,
        gain: Float32 | None = None,  # [3]
        rows: slice = ALL_ROWS,
    ) -> Float32:
        """Renders rows of an image in linear light, on as many threads as torch has.

        Args:
            time: seconds since the first frame.
            street_SE3_camera: [4, 4] pose of the camera, in the street's coordinates.
            lens: of the camera.
            gain: [3] factor of red, green and blue, on top of the light's exposure; ``None``: 1.
            rows: which ones.

        Returns:
            [rows, W, 3] in [0, 1].
        """
        # Late, since it imports torch: a log that is opened for its digest renders nothing.
        from genre_tasks.threads import map_single_threaded

        origin = street_SE3_camera[:3, 3]
        ray_angle = 1.0 / (max(lens.fx_px, 1e-6) * self.samples**0.5)
        rows_at_once = max(1, _RAYS_AT_ONCE // (lens.width_px * self.samples))
        start, stop, _ = rows.indices(lens.height_px)

        def render_band(first: int) -> Float32:
            band = slice(first, min(first + rows_at_once, stop))
            direction = rotate(street_SE3_camera[:3, :3], camera_rays(lens, self.samples, band))
            value = shade_rays(self.caster, self.light, origin, direction, time=time, ray_angle=ray_angle)
            value = value * np.float32(self.light.exposure)
            if gain is not None:
                value = value * gain
            # Bright samples are clipped first, so that an edge against the sky stays as smooth as a camera's.
            mean: Float32 = np.minimum(value, 1.0).reshape(-1, self.samples, 3).mean(1)
            return mean

        bands = map_single_threaded(render_band, range(start, stop, rows_at_once))
        return np.concatenate(bands).reshape(stop - start, lens.width_px, 3)


def camera_rays(lens: Lens, samples: int, rows: slice = ALL_ROWS) -> Float64:
    """Finds the rays through the pixels of an image.

    Args:
        lens: of the camera.
        samples: rays per pixel, a square number, on a fixed grid.
        rows: of the image.

    Returns:
        [rows · W · samples, 3] unit directions in camera axes (x right, y down, z forward); the samples of a pixel are
        neighbours.

    >>> camera_rays(Lens(10.0, 10.0, 0.5, 0.5, 1, 1), 1)
    array([[0., 0., 1.]])
    """
    # A fixed grid, not random samples: the same view is the same image.
    side = round(samples**0.5)
    step = (np.arange(side) + 0.5) / side
    dx, dy = np.meshgrid(step, step)
    # The grid's points are 0.5 / side from the pixel's edges, so a single sample is its centre.
    x = (np.arange(lens.width_px)[None, :, None] + dx.ravel() - lens.cx_px) / lens.fx_px
    y = (np.arange(lens.height_px)[rows, None, None] + dy.ravel() - lens.cy_px) / lens.fy_px
    x, y = np.broadcast_arrays(x, y)
    if any(lens.distortion):
        x, y = _undistort(x, y, lens.coefficients)
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    return rays / np.sqrt(dot_rows(rays, rays))[:, None]


def _undistort(x: Float64, y: Float64, coefficients: tuple[float, ...]) -> tuple[Float64, Float64]:
    """Inverse of Brown–Conrady by fixed-point iteration (converges for the mild distortion of such lenses)."""
    k1, k2, p1, p2, k3 = coefficients
    u = x
    v = y
    for _ in range(_UNDISTORTION_STEPS):
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        du = 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        dv = p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
        u = (x - du) / radial
        v = (y - dv) / radial
    return u, v


def encode_srgb(linear: Reals) -> NDArray[np.uint8]:
    """Converts linear light to 8-bit sRGB (IEC 61966-2-1).

    Args:
        linear: any shape; clipped to [0, 1].

    Returns:
        uint8 of the same shape.

    >>> encode_srgb(np.array([0.0, 0.2140, 1.0]))
    array([  0, 127, 255], dtype=uint8)
    """
    clipped = np.clip(linear.astype(np.float64), 0, 1)
    return np.round(linear_to_srgb(clipped) * 255).astype(np.uint8)
