"""One camera in plain torch, in any dtype, with autograd: lens distortion and rolling shutter, written for reading."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.render import constants as const
from genre_tasks.render.lens_domain import domain_of
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.lens_distortion import distort, slopes


class OneCamera:
    """View v of ``cameras`` in the dtype and on the device of ``like``."""

    def __init__(self, cameras: Cameras, v: int, like: Tensor) -> None:
        pose = cameras.camera_SE3_chunk[v].to(like)
        self.rotation, self.translation = pose[:3, :3], pose[:3, 3]  # chunk to camera
        (self.fx, self.fy), (self.cx, self.cy) = cameras.focal_px[v].to(like), cameras.center_px[v].to(like)
        self.width, self.height = cameras.width_px, cameras.height_px
        self.domain, self.antialiased = domain_of(cameras, v), cameras.antialiased
        self._distortion = () if cameras.distortion is None else cameras.distortion[v].to(like).unbind()
        shutter = cameras.shutter
        self.rolls = shutter is not None and bool(shutter.readout_s[v] != 0)
        if shutter is not None:
            self._readout, self._velocity, self._turn = (x[v].to(like) for x in vars(shutter).values())

    def velocities_of(self, splats: Splats) -> Tensor | None:
        """[N, 3] those of the Gaussians, where this camera asks for them."""
        return splats.velocities if self.rolls else None

    def posed(self, means: Tensor) -> Tensor:
        """Camera coordinates [K, 3] at the time of the pose."""
        return means @ self.rotation.T + self.translation

    def exposed(self, posed: Tensor, velocities: Tensor | None) -> Tensor:
        """Camera coordinates [K, 3] when the rows on which the points lie are exposed: see ``Shutter``."""
        return self.exposure(posed, velocities)[0]

    def exposure(self, posed: Tensor, velocities: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """As :meth:`exposed`, and what happens to pixels around, [K, 2, 2], to first order: lower rows come later."""
        if not self.rolls:
            return posed, None
        motion = -self._velocity - torch.linalg.cross(self._turn.expand_as(posed), posed)
        if velocities is not None:
            motion = motion + velocities.to(posed) @ self.rotation.T
        z = posed[:, 2]
        x, y = posed[:, 0] / z, posed[:, 1] / z
        x_rate, y_rate = (motion[:, 0] - x * motion[:, 2]) / z, (motion[:, 1] - y * motion[:, 2]) / z
        xx, xy, yy = self.slopes(x, y)
        row, row_rate = self.fy * self.bent(x, y)[1] + self.cy, self.fy * (xy * x_rate + yy * y_rate)
        column_rate = self.fx * (xx * x_rate + xy * y_rate)
        slowed = (1 - self._readout * row_rate / self.height).clamp(min=const.SHUTTER_MIN_RATE)
        half = self._readout / 2
        due = self._readout * (row / self.height - 0.5) / slowed
        time = due.clamp(-half, half)
        later = torch.where(time == due, self._readout / self.height / slowed, 0.0)  # s a row
        one, zero = torch.ones_like(later), torch.zeros_like(later)
        shear = torch.stack([one, later * column_rate, zero, 1 + later * row_rate], 1).view(-1, 2, 2)
        return posed + time[:, None] * motion, shear

    def unfolded(self, points: Tensor) -> Tensor:
        """[K] bool: the lens is one-to-one from the axis to there."""
        if self.domain is None:
            return torch.ones_like(points[:, 0], dtype=torch.bool)
        return (points[:, :2] / points[:, 2:]).square().sum(1) <= self.domain.fold_radius**2

    def bent(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Normalised image coordinates after the lens's distortion."""
        if self.domain is None:
            return x, y
        return distort(x, y, self._distortion)

    def slopes(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """∂x'/∂x, ∂x'/∂y = ∂y'/∂x and ∂y'/∂y of :meth:`bent`."""
        if self.domain is None:
            return torch.ones_like(x), torch.zeros_like(x), torch.ones_like(x)
        return slopes(x, y, self._distortion)

    def jacobian(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """[K, 2, 3] of pixels by camera coordinates, at a point of linearisation that is limited."""
        x, y = self._limited(x / z, y / z)
        fx, fy, zero = self.fx, self.fy, torch.zeros_like(z)
        if self.domain is None:
            return torch.stack([fx / z, zero, -fx * x / z, zero, fy / z, -fy * y / z], 1).view(-1, 2, 3)
        ray = torch.stack([1 / z, zero, -x / z, zero, 1 / z, -y / z], 1).view(-1, 2, 3)
        xx, xy, yy = self.slopes(x, y)
        lens = torch.stack([fx * xx, fx * xy, fy * xy, fy * yy], 1).view(-1, 2, 2)
        return lens @ ray

    def pixels(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """[K, 2] px, of camera coordinates."""
        if self.domain is None:
            return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], 1)
        x, y = self.bent(x / z, y / z)
        return torch.stack([self.fx * x + self.cx, self.fy * y + self.cy], 1)

    def _limited(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        if self.domain is not None:
            return x.clamp(-self.domain.left, self.domain.right), y.clamp(-self.domain.top, self.domain.bottom)
        fx, fy, cx, cy, width, height = self.fx, self.fy, self.cx, self.cy, self.width, self.height
        mx, my = const.JACOBIAN_MARGIN * width / (2 * fx), const.JACOBIAN_MARGIN * height / (2 * fy)
        return x.clamp(-cx / fx - mx, (width - cx) / fx + mx), y.clamp(-cy / fy - my, (height - cy) / fy + my)
