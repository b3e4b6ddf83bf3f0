"""Novel views, as the fixer and the enhancer exchange them."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from genre_tasks.logs.types import Float64, Lens


@dataclass(frozen=True)
class NovelView:
    """A viewpoint beside the path.

    Attributes:
        camera: of the rig, moved sideways.
        frame: log frame.
        shift_m: metres to the left.
        chunk_SE3_camera: [4, 4] float64.
        lens: that of the camera.
        reference: (camera, frame) of the nearest source view: same camera first, then distance, then angle.
    """

    camera: str
    frame: int
    shift_m: float
    chunk_SE3_camera: Float64
    lens: Lens
    reference: tuple[str, int]


@dataclass(frozen=True)
class NovelViews:
    """Renders of a scene, and of its LiDAR map, at V novel views; float32, colours sRGB premultiplied by alpha.

    Attributes:
        views: V viewpoints.
        color: [V, H, W, 3] in [0, 1].
        alpha: [V, H, W].
        depth: [V, H, W] Σ w z / Σ w in metres, 0 where Σ w = 0.
        lidar_color: [V, H, W, 3] of the LiDAR map: coloured points as discs on their surfaces.
        lidar_alpha: [V, H, W].
        lidar_depth: [V, H, W] metres, where rays meet the planes of the discs.
        culled: Gaussians of the scene that were left out, by reason, summed over the views; a measurement, which goes
            into the manifest.
        lidar_culled: the same for the LiDAR map.
    """

    views: tuple[NovelView, ...]
    color: Tensor
    alpha: Tensor
    depth: Tensor
    lidar_color: Tensor
    lidar_alpha: Tensor
    lidar_depth: Tensor
    culled: dict[str, int] = field(default_factory=dict)
    lidar_culled: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class FixedViews:
    """The fixer's images of V novel views.

    Attributes:
        views: V viewpoints, those of the renders.
        color: [V, H, W, 3] sRGB in [0, 1].
        copied: indices of views that did not call for fixing and are their renders; a measurement, which goes into the
            manifest.
        seconds_saved: about what leaving these out saved; a measurement, too.
    """

    views: tuple[NovelView, ...]
    color: Tensor
    copied: tuple[int, ...] = ()
    seconds_saved: float = 0.0
