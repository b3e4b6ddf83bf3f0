"""Flicker: how much consecutive images of a camera differ where they show the same points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from genre_tasks.fixer.view_surface import MIN_ALPHA, unproject_surface
from genre_tasks.fixer.warping import SourceImage, warp
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.rollout.moment_actors import pose_actors
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor
from genre_tasks.scene.transforms import invert_se3


class PosedCamera(Protocol):
    """A camera at a moment of the log; views of rollouts and novel views are such."""

    @property
    def camera(self) -> str:
        """Name of the camera."""
        ...

    @property
    def frame(self) -> float:
        """Log frame, or a moment between two."""
        ...

    @property
    def chunk_SE3_camera(self) -> Float64:
        """[4, 4] pose."""
        ...

    @property
    def lens(self) -> Lens:
        """Of the camera."""
        ...


@dataclass(frozen=True)
class DepthView:
    """Where a camera is and how far away what it shows is.

    Attributes:
        view: pose, lens and moment.
        alpha: [H, W] of the render.
        depth: [H, W] metres, 0 where nothing is.
    """

    view: PosedCamera
    alpha: Tensor
    depth: Tensor


@dataclass(frozen=True)
class WarpedDifference:
    """Absolute differences between images and their warped successors, summed.

    Attributes:
        total: sum over channels and pixels whose point both images show.
        count: how many values were summed.
    """

    total: float = 0.0
    count: float = 0.0

    def __add__(self, other: WarpedDifference) -> WarpedDifference:
        return WarpedDifference(self.total + other.total, self.count + other.count)

    @property
    def mean(self) -> float:
        """Mean absolute difference in [0, 1]; 0 without any overlap."""
        return self.total / max(self.count, 1.0)


def measure_warped_difference(
    images: Sequence[Tensor], now: DepthView, following: DepthView, actors: Sequence[Actor | ActorNode] = ()
) -> WarpedDifference:
    """Compares an image with the next one, warped to it by rendered depth.

    Args:
        images: two [H, W, 3] in [0, 1], sRGB: the image and the next one.
        now: of the first image.
        following: of the next one, in the same coordinates.
        actors: points on them move along.

    Returns:
        Their difference. A point that is outside of the next image or hidden there does not count.
    """
    moving = pose_actors(actors, {0: now.view.frame, 1: following.view.frame})
    view = now.view
    # Where the following render is transparent nothing can hide a point.
    opaque = following.alpha >= MIN_ALPHA
    hides = torch.where(opaque, following.depth, torch.zeros_like(following.depth))
    # The following image plays the role of a source, so that the fixer's warp can be used.
    source = SourceImage(
        camera=following.view.camera,
        frame=1,
        chunk_SE3_camera=following.view.chunk_SE3_camera,
        lens=following.view.lens,
        image=images[1].permute(2, 0, 1),
        depth=hides,
    )
    surface = unproject_surface(now.depth, now.alpha, view.chunk_SE3_camera, view.lens, moving, 0)
    warped = warp(surface, [source], moving, 0)
    difference = (warped.color - images[0].permute(2, 0, 1)).abs() * warped.mask
    return WarpedDifference(float(difference.sum()), float(3 * warped.mask.sum()))


class FlickerMeter:
    """Measures the flicker of a rollout while it is rendered; nothing but the last images is kept.

    All versions of the images are warped by the render's depth, so that their numbers compare.

    >>> FlickerMeter().flicker
    {}
    """

    def __init__(self) -> None:
        self._sums: dict[str, WarpedDifference] = {}
        self._last: tuple[RolloutImages, dict[str, Tensor]] | None = None

    def add(self, images: RolloutImages, versions: Mapping[str, Tensor]) -> None:
        """Adds the images of one pose.

        Args:
            images: of the render; after a gap in ``index`` nothing is compared.
            versions: name → [C, H, W, 3] in [0, 1], such as ``render``, ``fixed`` and ``truth``.
        """
        if self._last is not None and images.index == self._last[0].index + 1:
            self._compare(*self._last, images, versions)
        self._last = (images, dict(versions))

    @property
    def flicker(self) -> dict[str, float]:
        """Mean warped difference in [0, 1] of each version, over all cameras and pairs so far."""
        # Pixels of all pairs are summed first, so that a pair with little overlap weighs little.
        return {name: difference.mean for name, difference in self._sums.items()}

    def _compare(
        self,
        last: RolloutImages,
        last_versions: Mapping[str, Tensor],
        images: RolloutImages,
        versions: Mapping[str, Tensor],
    ) -> None:
        # The next pose may be in another chunk, whose origin is another one.
        last_SE3_world = invert_se3(last.chunk_scene.chunk.world_SE3_chunk)
        last_SE3_chunk = last_SE3_world @ images.chunk_scene.chunk.world_SE3_chunk
        cameras = {view.camera: k for k, view in enumerate(images.views)}
        for j, view in enumerate(last.views):
            k = cameras.get(view.camera)
            if k is None:
                continue
            now = DepthView(view, last.alpha[j], last.depth[j])
            next_view = images.views[k]
            if not np.array_equal(last_SE3_chunk, np.eye(4)):
                next_view = replace(next_view, chunk_SE3_camera=last_SE3_chunk @ next_view.chunk_SE3_camera)
            following = DepthView(next_view, images.alpha[k], images.depth[k])
            for name in versions.keys() & last_versions.keys():
                pair = (last_versions[name][j], versions[name][k])
                difference = measure_warped_difference(pair, now, following, last.chunk_scene.scene.actors)
                self._sums[name] = self._sums.get(name, WarpedDifference()) + difference
