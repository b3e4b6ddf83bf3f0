"""What the rig's cameras make of the street: shutter, exposure, the vehicle's own bonnet. The truth has none of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.logs.synthetic.camera_images import ALL_ROWS, Renderer, encode_srgb
from genre_tasks.logs.synthetic.ego_vehicle import EgoDrive, ego_SE3_camera
from genre_tasks.logs.synthetic.parameters import StreetParameters
from genre_tasks.logs.synthetic.road import make_generator
from genre_tasks.logs.types import Float32, Float64, Lens

# An exposure is the mean of so many moments.
_BLUR_MOMENTS = 8

# Share of an exposure's variance that differs from camera to camera and stays. The rest drifts as the log goes on,
# slowly enough that a frame's neighbours show it too.
_CONSTANT_SHARE = 0.6

# One swing in four to eight seconds, as an automatic exposure follows light and shade along a street.
_DRIFT_HZ = (0.12, 0.25)
# Linear colour of the bonnet.
_BONNET_PAINT = (0.055, 0.06, 0.065)

# Those that look ahead or back.
_BONNET_CAMERAS = ("front_camera", "back_camera")


@dataclass(frozen=True)
class CameraEffects:
    """Records images as the cameras of a seed and its parameters do.

    Attributes:
        parameters: of the street.
        ego: how the vehicle drives.
    """

    parameters: StreetParameters
    ego: EgoDrive

    @property
    def is_ideal(self) -> bool:
        """Whether an image is the truth at the recorded pose, to the bit."""
        p = self.parameters
        return not (p.rolling_shutter_s or p.exposure_s or p.exposure_jitter or p.white_balance_jitter or p.bonnet)

    def log_gain(self, camera: str, time_s: float) -> Float64:
        """Draws the exposure and white balance of an image.

        The standard deviation over cameras and time is ``exposure_jitter``, and ``white_balance_jitter`` for what
        differs between red, green and blue.

        Args:
            camera: name of the camera.
            time_s: seconds since the first frame.

        Returns:
            [3] natural logarithm of the gain in linear light.
        """
        p = self.parameters
        # Drawn anew for each image rather than kept: an image must not depend on which ones were asked for before.
        rng = make_generator(p.seed, f"gain of {camera}")
        constant = rng.normal(size=4)
        phase = rng.uniform(0, 2 * np.pi, 4)
        hertz = rng.uniform(*_DRIFT_HZ, 4)
        # The root of two gives the sine a standard deviation of 1.
        drift = np.sqrt(2) * np.sin(2 * np.pi * hertz * time_s + phase)
        unit = np.sqrt(_CONSTANT_SHARE) * constant + np.sqrt(1 - _CONSTANT_SHARE) * drift
        tint = unit[1:] - unit[1:].mean()
        # Taking the mean away leaves two thirds of the variance.
        return p.exposure_jitter * unit[0] + p.white_balance_jitter * np.sqrt(1.5) * tint

    def record_image(self, renderer: Renderer, camera: str, time_s: float, lens: Lens) -> NDArray[np.uint8]:
        """Renders an image as the camera records it: rows are read from the top, the middle one at ``time_s``.

        Args:
            renderer: of the street.
            camera: name of the camera.
            time_s: seconds since the first frame.
            lens: of the camera.

        Returns:
            [H, W, 3] sRGB.
        """
        p = self.parameters
        gain = np.exp(self.log_gain(camera, time_s)).astype(np.float32)
        offsets_s = np.zeros(1)
        if p.exposure_s:
            offsets_s = ((np.arange(_BLUR_MOMENTS) + 0.5) / _BLUR_MOMENTS - 0.5) * p.exposure_s
        # Mean and bonnet in linear light, as on a sensor; the curve comes last.
        total = np.zeros((lens.height_px, lens.width_px, 3), np.float32)
        for offset_s in offsets_s:
            for rows, row_offset_s in self._readout(lens):
                moment = time_s + offset_s + row_offset_s
                pose = self.street_SE3_camera(camera, moment)
                total[rows] += renderer.render_linear(moment, pose, lens, gain, rows)
        total /= np.float32(len(offsets_s))
        if p.bonnet:
            total = _paint_bonnet(bonnet_mask(p, camera, lens), total, gain)
        return encode_srgb(total)

    def _readout(self, lens: Lens) -> list[tuple[slice, float]]:
        """(rows that are read together, seconds from the pose's time to theirs)."""
        readout_s = self.parameters.rolling_shutter_s
        if not readout_s:
            return [(ALL_ROWS, 0.0)]
        height = lens.height_px
        # Row by row: each has a pose of its own.
        return [(slice(row, row + 1), ((row + 0.5) / height - 0.5) * readout_s) for row in range(height)]

    def street_SE3_camera(self, camera: str, time_s: float) -> Float64:
        """Poses a camera at any time, also between frames.

        Args:
            camera: name of the camera.
            time_s: seconds since the first frame.

        Returns:
            [4, 4] in the street's own coordinates.
        """
        return self.ego.pose(np.array([time_s]))[0] @ ego_SE3_camera(camera)


def bonnet_mask(parameters: StreetParameters, camera: str, lens: Lens) -> NDArray[np.bool_]:
    """Finds what of a camera's image the vehicle itself covers: ``parameters.bonnet`` of it, from the lower edge up.

    Args:
        parameters: of the street.
        camera: name of the camera; those that look to a side do not see the vehicle.
        lens: of the camera.

    Returns:
        [H, W] true where the vehicle is.

    >>> mask = bonnet_mask(StreetParameters(bonnet=0.25), "front_camera", Lens(50.0, 50.0, 50.0, 50.0, 100, 100))
    >>> float(mask.mean())
    0.25
    """
    mask = np.zeros((lens.height_px, lens.width_px), bool)
    if parameters.bonnet == 0 or camera not in _BONNET_CAMERAS:
        return mask
    x = (np.arange(lens.width_px) + 0.5) / lens.width_px * 2 - 1
    # An arch whose mean over x is 1.
    height = lens.height_px * parameters.bonnet * (1.2 - 0.6 * x**2)
    above_edge = lens.height_px - 0.5 - np.arange(lens.height_px)
    return above_edge[:, None] < height


def _paint_bonnet(mask: NDArray[np.bool_], image: Float32, gain: Float32) -> Float32:
    """The image [H, W, 3] with paint where the mask is true, brighter towards the top."""
    # The far edge of a bonnet mirrors the bright horizon.
    brightness = np.linspace(1.6, 0.8, len(image), dtype=np.float32)[:, None, None]
    paint = np.minimum(np.array(_BONNET_PAINT, np.float32) * brightness * gain, 1)
    return np.where(mask[..., None], paint, image)
