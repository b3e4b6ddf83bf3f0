"""How the rig's cameras record the street: shutter, exposure, the vehicle's own bonnet. The truth has none of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.camera_images import Light, radiance, to_srgb
from genre_tasks.logs.synthetic.ego_vehicle import Ego, ego_SE3_camera
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.raycast import Scene
from genre_tasks.logs.synthetic.road import generator
from genre_tasks.logs.types import Float32, Float64, Lens

BLUR_MOMENTS = 8
"""An exposure is the mean of so many moments."""

SHARED = 0.6
"""Of an exposure's variance, what differs from camera to camera and stays; the rest drifts as the log goes on, slowly
enough for a frame's neighbours to tell it."""

DRIFT_HZ = (0.12, 0.25)
PAINT = (0.055, 0.06, 0.065)
"""Linear colour of the bonnet."""


@dataclass(frozen=True)
class Imaging:
    """What a seed and its parameters make of the cameras. Plain parameters give the truth's own images."""

    parameters: StreetParameters
    ego: Ego

    @property
    def plain(self) -> bool:
        """Whether an image is the truth at the recorded pose, to the bit."""
        p = self.parameters
        return not (p.rolling_shutter_s or p.exposure_s or p.exposure_jitter or p.white_balance_jitter or p.bonnet)

    def log_gain(self, camera: str, time_s: float) -> Float64:
        """[3] natural logarithm of the gain in linear light of an image taken at ``time_s``.

        Its standard deviation over cameras and time is ``exposure_jitter``, and ``white_balance_jitter`` for what
        differs between red, green and blue.
        """
        p = self.parameters
        rng = generator(p.seed, f"gain of {camera}")
        offset, phase, hertz = rng.normal(size=4), rng.uniform(0, 2 * np.pi, 4), rng.uniform(*DRIFT_HZ, 4)
        wave = np.sqrt(2) * np.sin(2 * np.pi * hertz * time_s + phase)
        unit = np.sqrt(SHARED) * offset + np.sqrt(1 - SHARED) * wave
        tint = unit[1:] - unit[1:].mean()
        return p.exposure_jitter * unit[0] + p.white_balance_jitter * np.sqrt(1.5) * tint

    def image(self, scene: Scene, light: Light, camera: str, time_s: float, lens: Lens) -> NDArray[np.uint8]:
        """[H, W, 3] sRGB as the camera records it; rows are read from the top, the middle one at ``time_s``."""
        p = self.parameters
        gain = np.exp(self.log_gain(camera, time_s)).astype(np.float32)
        moments = np.zeros(1)
        if p.exposure_s:
            moments = ((np.arange(BLUR_MOMENTS) + 0.5) / BLUR_MOMENTS - 0.5) * p.exposure_s
        total = np.zeros((lens.height_px, lens.width_px, 3), np.float32)
        for moment in moments:
            if p.rolling_shutter_s:
                for row in range(lens.height_px):
                    at = time_s + moment + ((row + 0.5) / lens.height_px - 0.5) * p.rolling_shutter_s
                    rows = slice(row, row + 1)
                    total[rows] += radiance(scene, light, at, self.camera_pose(camera, at), lens, p.samples, gain, rows)
            else:
                at = time_s + moment
                total += radiance(scene, light, at, self.camera_pose(camera, at), lens, p.samples, gain)
        total /= np.float32(len(moments))
        if p.bonnet:
            total = _over(bonnet(p, camera, lens), total, gain)
        return to_srgb(total)

    def camera_pose(self, camera: str, time_s: float) -> Float64:
        """[4, 4] in the street's own coordinates."""
        return self.ego.pose(np.array([time_s]))[0] @ ego_SE3_camera(camera)


def bonnet(parameters: StreetParameters, camera: str, lens: Lens) -> NDArray[np.bool_]:
    """[H, W] what of a camera's image the vehicle itself covers: ``parameters.bonnet`` of it, from the lower edge up.

    Cameras that look ahead or back see it; those that look to a side do not.
    """
    out = np.zeros((lens.height_px, lens.width_px), bool)
    if parameters.bonnet == 0 or camera not in ("front_camera", "back_camera"):
        return out
    x = (np.arange(lens.width_px) + 0.5) / lens.width_px * 2 - 1
    height = lens.height_px * parameters.bonnet * (1.2 - 0.6 * x**2)  # its mean over x is 1
    rows = lens.height_px - 0.5 - np.arange(lens.height_px)
    return rows[:, None] < height


def _over(covered: NDArray[np.bool_], image: Float32, gain: Float32) -> Float32:
    """The image [H, W, 3], with paint that shines a little towards its upper edge where it is covered."""
    shine = np.linspace(1.6, 0.8, len(image), dtype=np.float32)[:, None, None]
    paint = np.minimum(np.array(PAINT, np.float32) * shine * gain, 1)
    return np.where(covered[..., None], paint, image)
