"""What goes into a renderer and what comes out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64, Lens


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size.

    ``camera_SE3_chunk`` [V, 4, 4] takes chunk coordinates to camera coordinates (x right, y down, z forward).
    """

    camera_SE3_chunk: Tensor  # [V, 4, 4]
    focal_px: Tensor  # [V, 2] fx, fy
    center_px: Tensor  # [V, 2] cx, cy; first pixel's centre is (0.5, 0.5)
    width_px: int
    height_px: int

    def __len__(self) -> int:
        return self.camera_SE3_chunk.shape[0]

    def select(self, views: Sequence[int]) -> Cameras:
        """The cameras of some views, in that order."""
        at = torch.tensor(views, device=self.focal_px.device)
        pose, focal, center = (x.index_select(0, at) for x in (self.camera_SE3_chunk, self.focal_px, self.center_px))
        return Cameras(pose, focal, center, self.width_px, self.height_px)

    @staticmethod
    def of(poses: Sequence[Float64], lenses: Sequence[Lens], dtype: torch.dtype = torch.float32) -> Cameras:
        """From ``chunk_SE3_camera`` poses and lenses of one size. Raises ``ValueError`` for mixed sizes."""
        sizes = {(lens.width_px, lens.height_px) for lens in lenses}
        if len(sizes) != 1:
            raise ValueError(f"expected lenses of one image size, got {sorted(sizes)}")
        ((width, height),) = sizes
        inverse = np.linalg.inv(np.stack(poses))
        return Cameras(
            torch.as_tensor(inverse, dtype=dtype),
            torch.tensor([[lens.fx_px, lens.fy_px] for lens in lenses], dtype=dtype),
            torch.tensor([[lens.cx_px, lens.cy_px] for lens in lenses], dtype=dtype),
            width,
            height,
        )


@dataclass(frozen=True)
class Shown:
    """Which of N Gaussians each view shows: the first ``shared``, and view v those in ``range(*own[v])``."""

    shared: int
    own: tuple[tuple[int, int], ...]

    @staticmethod
    def all_of(count: int, views: int) -> Shown:
        """Everything in every view."""
        return Shown(count, ((count, count),) * views)

    @staticmethod
    def of_frames(shared: int, moving: int, frames: Sequence[int]) -> Shown:
        """For views at these log frames: what stays, then what moves once for each frame, as ``SceneGraph.posed``."""
        place = {frame: i for i, frame in enumerate(dict.fromkeys(frames))}
        begins = [shared + place[frame] * moving for frame in frames]
        return Shown(shared, tuple((begin, begin + moving) for begin in begins))

    def of(self, v: int) -> Shown:
        """For view v alone."""
        return Shown(self.shared, (self.own[v],))


@dataclass(frozen=True)
class RenderSettings:
    """How to render; ``backend`` ``auto`` picks ``cuda`` for tensors on a GPU and ``cpu`` otherwise."""

    backend: Literal["auto", "reference", "cpu", "cuda"] = "auto"
    threads: int | None = None


@dataclass(frozen=True)
class Render:
    """V images, differentiable. Colour is premultiplied (black behind); depth is not divided.

    ``culled`` counts Gaussians left out per reason (``non_finite``, ``quaternion``, ``behind`` …), summed over views.
    """

    color: Tensor  # [V, H, W, 3] Σ w c
    alpha: Tensor  # [V, H, W] Σ w
    depth: Tensor  # [V, H, W] Σ w z, metres
    culled: dict[str, int] = field(default_factory=dict)

    def expected_depth(self) -> Tensor:
        """[V, H, W] Σ w z / Σ w, 0 with no gradient where Σ w = 0."""
        hit = self.alpha > 0
        return torch.where(hit, self.depth / torch.where(hit, self.alpha, 1.0), torch.zeros_like(self.depth))
