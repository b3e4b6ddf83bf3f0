"""Novel views, as the fixer and the enhancer exchange them."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from genre_tasks.logs.types import Float64, Lens


@dataclass(frozen=True)
class NovelView:
    """A viewpoint beside the path: camera × frame, moved ``shift_m`` to the left, with its nearest source image.

    ``reference`` is (camera, frame) of a source view of the chunk: same camera first, then distance, then angle.
    """

    camera: str
    frame: int
    shift_m: float
    chunk_SE3_camera: Float64  # [4, 4]
    lens: Lens
    reference: tuple[str, int]


@dataclass(frozen=True)
class NovelViews:
    """Renders of a scene at V novel views, float32, colour sRGB in [0, 1] premultiplied by alpha.

    ``culled`` and ``lidar_culled`` count left-out Gaussians of the scene and of the LiDAR map by reason, summed over
    the views: measurements, which go into the manifest.
    """

    views: tuple[NovelView, ...]
    color: Tensor  # [V, H, W, 3]
    alpha: Tensor  # [V, H, W]
    depth: Tensor  # [V, H, W] Σ w z / Σ w in metres, 0 where Σ w = 0
    lidar_color: Tensor  # [V, H, W, 3] the LiDAR map: coloured points rendered as discs on their surfaces
    lidar_alpha: Tensor  # [V, H, W]
    lidar_depth: Tensor  # [V, H, W] where rays meet the planes of the discs
    culled: dict[str, int] = field(default_factory=dict)
    lidar_culled: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class FixedViews:
    """The fixer's images of the same views.

    ``copied`` are the indices of views that did not call for fixing and are their renders, ``seconds_saved`` about what
    that saved: measurements, which go into the manifest.
    """

    views: tuple[NovelView, ...]
    color: Tensor  # [V, H, W, 3] sRGB in [0, 1]
    copied: tuple[int, ...] = ()
    seconds_saved: float = 0.0
