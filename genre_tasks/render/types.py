"""What goes into a renderer and what comes out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from genre_tasks.logs.types import Float64, Lens, RollingShutter


@dataclass(frozen=True)
class Shutter:
    """How V cameras move while their images are read out, top row first; the poses hold for the middle row.

    A Gaussian is projected from where the camera sees it at the time τ of its row (row r of H, continuous, is exposed
    (r / H − ½) · ``readout_s`` after the pose's time): from p = p₀ + τ d, for p₀ at the pose's time and
    d = R w − (v + ω × p₀), with the camera's velocity v and turn ω and the Gaussian's own velocity w. The row y moves
    with τ, too: one Newton step from τ = 0 gives τ = T (y₀ / H − ½) / (1 − T ẏ₀ / H), limited to ± T / 2, and exact
    where ẏ does not change. The divisor is at least ``SHUTTER_MIN_RATE``.

    A footprint is sheared, as its lower rows come later: by [[1, λ ẋ₀], [0, 1 + λ ẏ₀]] with λ = ∂τ/∂y₀, which is 0
    where τ is limited. Gaussians are drawn in the order of their depths at the pose's time; the depth image has those
    at τ. Readout 0 is no shutter, to the bit.
    """

    readout_s: Tensor  # [V] T
    velocity_m_s: Tensor  # [V, 3] of the camera, in camera axes
    turn_rad_s: Tensor  # [V, 3] of the camera, in camera axes

    def map(self, f: Callable[[Tensor], Tensor]) -> Shutter:
        """Of each tensor what ``f`` makes of it."""
        return Shutter(f(self.readout_s), f(self.velocity_m_s), f(self.turn_rad_s))

    @staticmethod
    def of(shutters: Sequence[RollingShutter | None], dtype: torch.dtype = torch.float32) -> Shutter | None:
        """Of V views, ``None`` for those with a global shutter; ``None`` where all have one."""
        if not any(shutters):
            return None
        still = RollingShutter(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        each = [shutter or still for shutter in shutters]
        return Shutter(
            torch.tensor([s.readout_s for s in each], dtype=dtype),
            torch.tensor([s.velocity_m_s for s in each], dtype=dtype),
            torch.tensor([s.turn_rad_s for s in each], dtype=dtype),
        )


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size, each with a lens distortion and a rolling shutter if these are given.

    ``camera_SE3_chunk`` [V, 4, 4] takes chunk coordinates to camera coordinates (x right, y down, z forward). A view
    whose distortion is all 0, or whose readout is 0, has the same bits as without.

    ``antialiased``: opacities are lowered by sqrt(det Σ / det(Σ + ``BLUR_PX2``)) for each projected covariance Σ, at
    least ``COMPENSATION_MIN``, so that the blur does not make a small footprint brighter than it is (Mip-Splatting,
    Yu et al. 2024).
    """

    camera_SE3_chunk: Tensor  # [V, 4, 4]
    focal_px: Tensor  # [V, 2] fx, fy
    center_px: Tensor  # [V, 2] cx, cy; first pixel's centre is (0.5, 0.5)
    width_px: int
    height_px: int
    distortion: Tensor | None = None  # [V, 5] Brown–Conrady k1, k2, p1, p2, k3
    shutter: Shutter | None = None
    antialiased: bool = False

    def __len__(self) -> int:
        return self.camera_SE3_chunk.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """Those that are there, by name."""
        named = {n: getattr(self, n) for n in ("camera_SE3_chunk", "focal_px", "center_px", "distortion")}
        if self.shutter is not None:
            named |= vars(self.shutter)
        return {n: x for n, x in named.items() if x is not None}

    def map(self, f: Callable[[Tensor], Tensor]) -> Cameras:
        """With each tensor as ``f`` makes it."""
        return Cameras(
            f(self.camera_SE3_chunk),
            f(self.focal_px),
            f(self.center_px),
            self.width_px,
            self.height_px,
            None if self.distortion is None else f(self.distortion),
            None if self.shutter is None else self.shutter.map(f),
            self.antialiased,
        )

    def select(self, views: Sequence[int]) -> Cameras:
        """The cameras of some views, in that order."""
        at = torch.tensor(views, dtype=torch.int64, device=self.focal_px.device)
        return self.map(lambda x: x.index_select(0, at))

    @staticmethod
    def of(
        poses: Sequence[Float64],
        lenses: Sequence[Lens],
        dtype: torch.dtype = torch.float32,
        shutters: Sequence[RollingShutter | None] = (),
        antialiased: bool = False,
    ) -> Cameras:
        """From ``chunk_SE3_camera`` poses, lenses of one size and, if any, their shutters.

        Raises ``ValueError`` for mixed sizes.
        """
        sizes = {(lens.width_px, lens.height_px) for lens in lenses}
        if len(sizes) != 1:
            raise ValueError(f"expected lenses of one image size, got {sorted(sizes)}")
        ((width, height),) = sizes
        inverse = np.linalg.inv(np.stack(poses))
        bent = any(any(lens.distortion) for lens in lenses)
        return Cameras(
            torch.as_tensor(inverse, dtype=dtype),
            torch.tensor([[lens.fx_px, lens.fy_px] for lens in lenses], dtype=dtype),
            torch.tensor([[lens.cx_px, lens.cy_px] for lens in lenses], dtype=dtype),
            width,
            height,
            torch.tensor([lens.coefficients for lens in lenses], dtype=dtype) if bent else None,
            Shutter.of(shutters, dtype),
            antialiased,
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
    def of_frames(shared: int, moving: int, frames: Sequence[float]) -> Shown:
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
