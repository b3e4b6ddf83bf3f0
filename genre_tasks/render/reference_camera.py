"""One camera in plain torch, in any dtype, with autograd: lens distortion and rolling shutter, written for reading."""

from __future__ import annotations

import torch
from torch import Tensor

from genre_tasks.logs.brown_conrady import distort, distortion_jacobian
from genre_tasks.render import constants as const
from genre_tasks.render.lens_domain import find_valid_domain
from genre_tasks.render.types import Cameras
from genre_tasks.scene.gaussians import Splats


class ReferenceCamera:
    """View v of some cameras, in the dtype and on the device of a tensor.

    Attributes:
        rotation: [3, 3], from chunk to camera axes.
        translation: [3] metres.
        fx, fy, cx, cy: pixels.
        width, height: pixels.
        domain: limits of a lens that distorts, else ``None``.
        antialiased: as ``Cameras`` has it.
        has_rolling_shutter: whether the camera moves while its image is read out.
    """

    def __init__(self, cameras: Cameras, v: int, like: Tensor) -> None:
        """Takes one view's camera.

        Args:
            cameras: V of them.
            v: which view.
            like: gives dtype and device.
        """
        pose = cameras.camera_SE3_chunk[v].to(like)
        self.rotation = pose[:3, :3]
        self.translation = pose[:3, 3]
        self.fx, self.fy = cameras.focal_px[v].to(like)
        self.cx, self.cy = cameras.center_px[v].to(like)
        self.width = cameras.width_px
        self.height = cameras.height_px
        self.domain = find_valid_domain(cameras, v)
        self.antialiased = cameras.antialiased
        # Unpacked once: indexing a tensor by each formula would cost more than the formula.
        self._coefficients = () if cameras.distortion is None else cameras.distortion[v].to(like).unbind()
        shutter = cameras.shutter
        self.has_rolling_shutter = shutter is not None and bool(shutter.readout_s[v] != 0)
        if shutter is not None:
            self._readout, self._velocity, self._turn = (x[v].to(like) for x in vars(shutter).values())

    def relevant_velocities(self, splats: Splats) -> Tensor | None:
        """Velocities [N, 3] of splats, where this camera has a shutter and so asks for them."""
        return splats.velocities if self.has_rolling_shutter else None

    def to_camera(self, means: Tensor) -> Tensor:
        """Takes points to camera coordinates at the time of the pose.

        Args:
            means: [K, 3] metres, chunk coordinates.

        Returns:
            [K, 3] metres.
        """
        return means @ self.rotation.T + self.translation

    def move_to_exposure(self, posed: Tensor, velocities: Tensor | None) -> Tensor:
        """Takes points to where the camera sees them when their rows are exposed: see ``Shutter``.

        Args:
            posed: [K, 3] metres, camera coordinates at the time of the pose.
            velocities: [K, 3] m/s in chunk axes; ``None``: the points rest.

        Returns:
            [K, 3] metres, camera coordinates then; ``posed`` itself with a global shutter.
        """
        return self.move_to_exposure_with_shear(posed, velocities)[0]

    def move_to_exposure_with_shear(self, posed: Tensor, velocities: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """As :meth:`move_to_exposure`, with what a rolling shutter does to pixels around each point.

        Args:
            posed: [K, 3] metres, camera coordinates at the time of the pose.
            velocities: [K, 3] m/s in chunk axes; ``None``: the points rest.

        Returns:
            [K, 3] metres; and the slopes [K, 2, 2] of pixels after the shutter by pixels before it, since lower rows
            come later, ``None`` with a global shutter.
        """
        # The same tensor comes back, so that a global shutter gives the same bits as no shutter at all.
        if not self.has_rolling_shutter:
            return posed, None
        motion = -self._velocity - torch.linalg.cross(self._turn.expand_as(posed), posed)
        if velocities is not None:
            motion = motion + velocities.to(posed) @ self.rotation.T
        z = posed[:, 2]
        x = posed[:, 0] / z
        y = posed[:, 1] / z
        # The quotient rule for x/z and y/z.
        x_rate = (motion[:, 0] - x * motion[:, 2]) / z
        y_rate = (motion[:, 1] - y * motion[:, 2]) / z
        xx, xy, yy = self.distortion_jacobian(x, y)
        row = self.fy * self.distort(x, y)[1] + self.cy
        row_rate = self.fy * (xy * x_rate + yy * y_rate)
        column_rate = self.fx * (xx * x_rate + xy * y_rate)
        rate = (1 - self._readout * row_rate / self.height).clamp(min=const.SHUTTER_MIN_RATE)
        half = self._readout / 2
        # One Newton step for the row at which the point is when that row is read out.
        row_time = self._readout * (row / self.height - 0.5) / rate
        time = row_time.clamp(-half, half)
        # Where the time is limited it does not change with the row.
        delay_per_row = torch.where(time == row_time, self._readout / self.height / rate, 0.0)
        one = torch.ones_like(delay_per_row)
        zero = torch.zeros_like(delay_per_row)
        shear = torch.stack([one, delay_per_row * column_rate, zero, 1 + delay_per_row * row_rate], 1).view(-1, 2, 2)
        return posed + time[:, None] * motion, shear

    def is_unfolded(self, points: Tensor) -> Tensor:
        """Tells where the lens is one-to-one from its axis to a point.

        Args:
            points: [K, 3] metres, camera coordinates.

        Returns:
            [K] bool.
        """
        if self.domain is None:
            return torch.ones_like(points[:, 0], dtype=torch.bool)
        return (points[:, :2] / points[:, 2:]).square().sum(1) <= self.domain.fold_radius**2

    def distort(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Bends normalised image coordinates as the lens does.

        Args:
            x: [K] x/z.
            y: [K] y/z.
        """
        if self.domain is None:
            return x, y
        return distort(x, y, self._coefficients)

    def distortion_jacobian(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Computes the slopes of :meth:`distort`.

        Args:
            x: [K] x/z.
            y: [K] y/z.

        Returns:
            ∂x'/∂x, ∂x'/∂y = ∂y'/∂x and ∂y'/∂y, each [K].
        """
        if self.domain is None:
            return torch.ones_like(x), torch.zeros_like(x), torch.ones_like(x)
        return distortion_jacobian(x, y, self._coefficients)

    def projection_jacobian(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Linearises the projection, at points that are limited to the image and a margin (EWA splatting).

        Args:
            x: [K] metres, camera coordinates.
            y: [K] metres.
            z: [K] metres, above 0.

        Returns:
            Slopes [K, 2, 3] of pixels by camera coordinates.
        """
        # Far off the axis the linearisation explodes: footprints would cover the image (as in 3DGS).
        x, y = self._limit(x / z, y / z)
        fx = self.fx
        fy = self.fy
        zero = torch.zeros_like(z)
        if self.domain is None:
            return torch.stack([fx / z, zero, -fx * x / z, zero, fy / z, -fy * y / z], 1).view(-1, 2, 3)
        # The chain of two slopes: of normalised coordinates by camera coordinates, then of pixels by these.
        ray = torch.stack([1 / z, zero, -x / z, zero, 1 / z, -y / z], 1).view(-1, 2, 3)
        xx, xy, yy = self.distortion_jacobian(x, y)
        lens = torch.stack([fx * xx, fx * xy, fy * xy, fy * yy], 1).view(-1, 2, 2)
        return lens @ ray

    def to_pixels(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """Projects points.

        Args:
            x: [K] metres, camera coordinates.
            y: [K] metres.
            z: [K] metres, above 0.

        Returns:
            [K, 2] pixels, column and row.
        """
        if self.domain is None:
            return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], 1)
        x, y = self.distort(x / z, y / z)
        return torch.stack([self.fx * x + self.cx, self.fy * y + self.cy], 1)

    def _limit(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        if self.domain is not None:
            return x.clamp(-self.domain.left, self.domain.right), y.clamp(-self.domain.top, self.domain.bottom)
        margin_x = const.JACOBIAN_MARGIN * self.width / (2 * self.fx)
        margin_y = const.JACOBIAN_MARGIN * self.height / (2 * self.fy)
        left = -self.cx / self.fx - margin_x
        right = (self.width - self.cx) / self.fx + margin_x
        top = -self.cy / self.fy - margin_y
        bottom = (self.height - self.cy) / self.fy + margin_y
        return x.clamp(left, right), y.clamp(top, bottom)
