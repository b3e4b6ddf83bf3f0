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

    Attributes:
        readout_s: [V] T, seconds from the first row to the last.
        velocity_m_s: [V, 3] of the camera, in camera axes.
        turn_rad_s: [V, 3] of the camera, in camera axes.
    """

    readout_s: Tensor
    velocity_m_s: Tensor
    turn_rad_s: Tensor

    def map(self, f: Callable[[Tensor], Tensor]) -> Shutter:
        """Applies a function to each tensor."""
        return Shutter(f(self.readout_s), f(self.velocity_m_s), f(self.turn_rad_s))

    @staticmethod
    def from_rolling_shutters(
        shutters: Sequence[RollingShutter | None], dtype: torch.dtype = torch.float32
    ) -> Shutter | None:
        """Collects the shutters of V views.

        Args:
            shutters: V of them, ``None`` for a global shutter.
            dtype: of the tensors.

        Returns:
            ``None`` where all views have a global shutter.
        """
        # None and not a table of zeros, because kernels without a shutter are quicker.
        if not any(shutters):
            return None
        # One table for all views: a readout of 0 stands for a global shutter.
        still = RollingShutter(0.0, velocity_m_s=(0.0, 0.0, 0.0), turn_rad_s=(0.0, 0.0, 0.0))
        per_view = [shutter or still for shutter in shutters]
        return Shutter(
            torch.tensor([s.readout_s for s in per_view], dtype=dtype),
            torch.tensor([s.velocity_m_s for s in per_view], dtype=dtype),
            torch.tensor([s.turn_rad_s for s in per_view], dtype=dtype),
        )


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size, each with a lens distortion and a rolling shutter if these are given.

    A view whose distortion is all 0, or whose readout is 0, has the same bits as without.

    Attributes:
        camera_SE3_chunk: [V, 4, 4], from chunk to camera coordinates (x right, y down, z forward).
        focal_px: [V, 2] fx, fy.
        center_px: [V, 2] cx, cy; the first pixel's centre is (0.5, 0.5).
        width_px: of all images.
        height_px: of all images.
        distortion: [V, 5] Brown–Conrady k1, k2, p1, p2, k3.
        shutter: motion during the readout.
        antialiased: opacities are lowered by sqrt(det Σ / det(Σ + ``BLUR_PX2``)) for each projected covariance Σ, at
            least ``COMPENSATION_MIN``, so that the blur does not make a small footprint brighter than it is
            (Mip-Splatting, Yu et al. 2024).
    """

    camera_SE3_chunk: Tensor
    focal_px: Tensor
    center_px: Tensor
    width_px: int
    height_px: int
    distortion: Tensor | None = None
    shutter: Shutter | None = None
    antialiased: bool = False

    def __len__(self) -> int:
        return self.camera_SE3_chunk.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """The tensors that are there, by name."""
        named = {n: getattr(self, n) for n in ("camera_SE3_chunk", "focal_px", "center_px", "distortion")}
        if self.shutter is not None:
            named |= vars(self.shutter)
        return {n: x for n, x in named.items() if x is not None}

    def map(self, f: Callable[[Tensor], Tensor]) -> Cameras:
        """Applies a function to each tensor."""
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
        """Copies the cameras of some views, in that order.

        Args:
            views: indices.
        """
        rows = torch.tensor(views, dtype=torch.int64, device=self.focal_px.device)
        return self.map(lambda x: x.index_select(0, rows))

    def to_device_of(self, tensor: Tensor) -> Cameras:
        """Moves the cameras to another tensor's device."""
        return self.map(lambda x: x.to(tensor.device))

    @staticmethod
    def from_poses(
        poses: Sequence[Float64],
        lenses: Sequence[Lens],
        dtype: torch.dtype = torch.float32,
        shutters: Sequence[RollingShutter | None] = (),
        antialiased: bool = False,
    ) -> Cameras:
        """Makes cameras of poses as logs and chunks have them.

        Args:
            poses: V ``chunk_SE3_camera`` [4, 4].
            lenses: V, of one image size.
            dtype: of the tensors.
            shutters: V, ``None`` for a global shutter; empty: all are global.
            antialiased: see :class:`Cameras`.

        Raises:
            ValueError: the lenses have several image sizes.

        >>> lens = Lens(fx_px=50.0, fy_px=50.0, cx_px=32.0, cy_px=24.0, width_px=64, height_px=48)
        >>> cameras = Cameras.from_poses([np.eye(4), np.eye(4)], [lens, lens])
        >>> len(cameras), cameras.focal_px.tolist()
        (2, [[50.0, 50.0], [50.0, 50.0]])
        """
        sizes = {(lens.width_px, lens.height_px) for lens in lenses}
        # Images of one call share a tensor, so they need one size.
        if len(sizes) != 1:
            raise ValueError(f"expected lenses of one image size, got {sorted(sizes)}")
        ((width, height),) = sizes
        # Inverted in float64, and rounded once.
        inverse = np.linalg.inv(np.stack(poses))
        # One lens with distortion gives all views coefficients; zeros change no bit of the others.
        distorted = any(any(lens.distortion) for lens in lenses)
        return Cameras(
            torch.as_tensor(inverse, dtype=dtype),
            torch.tensor([[lens.fx_px, lens.fy_px] for lens in lenses], dtype=dtype),
            torch.tensor([[lens.cx_px, lens.cy_px] for lens in lenses], dtype=dtype),
            width,
            height,
            torch.tensor([lens.coefficients for lens in lenses], dtype=dtype) if distorted else None,
            Shutter.from_rolling_shutters(shutters, dtype),
            antialiased,
        )


@dataclass(frozen=True)
class VisibleRanges:
    """Which of N Gaussians each of V views shows, so that views of several log frames can share one render.

    Attributes:
        shared: all views show the first so many.
        per_view: [V] (begin, end): view v shows those of this range, too.
    """

    shared: int
    per_view: tuple[tuple[int, int], ...]

    @staticmethod
    def everything(count: int, views: int) -> VisibleRanges:
        """Shows all Gaussians in every view.

        >>> VisibleRanges.everything(5, 2)
        VisibleRanges(shared=5, per_view=((5, 5), (5, 5)))
        """
        # Everything is shared, so each view's own range is empty.
        return VisibleRanges(count, ((count, count),) * views)

    @staticmethod
    def for_frames(shared: int, moving: int, frames: Sequence[float]) -> VisibleRanges:
        """Shows each view the Gaussians of its log frame, laid out as by ``SceneGraph.gaussians_at_frames``.

        Args:
            shared: number of Gaussians that do not move.
            moving: number of those that do; they are there once for each distinct frame.
            frames: [V] log frame of each view.

        >>> VisibleRanges.for_frames(10, 3, [4, 4, 7]).per_view
        ((10, 13), (10, 13), (13, 16))
        """
        # In the order of first appearance, as the scene graph poses them.
        rank = {frame: i for i, frame in enumerate(dict.fromkeys(frames))}
        begins = [shared + rank[frame] * moving for frame in frames]
        return VisibleRanges(shared, tuple((begin, begin + moving) for begin in begins))

    def for_view(self, v: int) -> VisibleRanges:
        """The ranges of one view alone."""
        return VisibleRanges(self.shared, (self.per_view[v],))


@dataclass(frozen=True)
class RenderSettings:
    """How to render.

    Attributes:
        backend: ``auto`` picks ``cuda`` for tensors on a GPU and ``cpu`` otherwise.
        threads: of the ``cpu`` backend; ``None``: as many as torch has.
    """

    backend: Literal["auto", "reference", "cpu", "cuda"] = "auto"
    threads: int | None = None


@dataclass(frozen=True)
class Render:
    """V images, differentiable. Colour is premultiplied (black behind); depth is not divided by alpha.

    Attributes:
        color: [V, H, W, 3] Σ w c.
        alpha: [V, H, W] Σ w.
        depth: [V, H, W] Σ w z, metres.
        culled: Gaussians left out, by reason (``non_finite``, ``quaternion``, ``behind`` …), summed over views.
    """

    color: Tensor
    alpha: Tensor
    depth: Tensor
    culled: dict[str, int] = field(default_factory=dict)

    def expected_depth(self) -> Tensor:
        """Divides the depth by alpha.

        Returns:
            [V, H, W] Σ w z / Σ w in metres, 0 with no gradient where Σ w = 0.
        """
        hit = self.alpha > 0
        # Both branches of `where` must be finite: a division by 0 in the branch not taken still makes gradients NaN.
        return torch.where(hit, self.depth / torch.where(hit, self.alpha, 1.0), torch.zeros_like(self.depth))
