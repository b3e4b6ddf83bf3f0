"""The true images of a street whose traffic was edited: what re-simulation is scored against.

``traffic_edits`` makes the layouts. Nothing of the log itself imports this module: its images and its digest stay what
they are.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.logs.synthetic.camera_images import Renderer, camera_rays
from genre_tasks.logs.synthetic.ego_vehicle import FRAME_S
from genre_tasks.logs.synthetic.log import SyntheticStreet
from genre_tasks.logs.synthetic.raycast import Hits, RayCaster
from genre_tasks.logs.synthetic.shading import draw_light
from genre_tasks.logs.synthetic.street_layout import StreetLayout
from genre_tasks.logs.types import Float64, Lens

# The sky is so far away that no camera of a log sees it move.
_SKY_M = 1e4
# A ray to a point is free if it gets so near to it: float32 and the slant of a face take the rest.
_FREE_SHARE = 0.99
_FREE_M = 0.1


@dataclass(frozen=True)
class TruthView:
    """A camera at a moment of a log.

    Attributes:
        moment: log frame, or a moment between two.
        world_SE3_camera: [4, 4].
        lens: of the camera; its size is the image's.
    """

    moment: float
    world_SE3_camera: Float64
    lens: Lens


class EditedStreet:
    """A street with other traffic: its true image, and what of it an actor covers, at any camera pose and moment.

    Args:
        log: the street as it was recorded, for light, samples and offset.
        layout: what stands and moves on it.
    """

    def __init__(self, log: SyntheticStreet, layout: StreetLayout) -> None:
        self.layout = layout
        self._offset_m = log.offset_m
        self._samples = log.parameters.samples
        self._caster = RayCaster(layout)
        light = draw_light(log.parameters.seed, log.parameters.gloss)
        self._renderer = Renderer(self._caster, light, self._samples)

    def image(self, view: TruthView) -> NDArray[np.uint8]:
        """Renders what a camera sees.

        Args:
            view: camera and moment; a moment before or after the log is allowed.

        Returns:
            [H, W, 3] sRGB; for the recorded layout the same bytes as ``log.truth.image``.
        """
        return self._renderer.render_srgb(view.moment * FRAME_S, self._to_street(view.world_SE3_camera), view.lens)

    def mask_actors(self, view: TruthView, names: Collection[str]) -> NDArray[np.bool_]:
        """Finds the pixels in which actors are visible, without their shadows.

        Args:
            view: camera and moment.
            names: track ids of the actors; those that are not on this street cover nothing.

        Returns:
            [H, W] true where any sample of the pixel meets one of them.
        """
        mask = np.zeros((view.lens.height_px, view.lens.width_px), bool)
        for name, visible in self.find_actors(view).items():
            if name in names:
                mask |= visible
        return mask

    def find_actors(self, view: TruthView) -> dict[str, NDArray[np.bool_]]:
        """Finds which actors a camera sees, and where.

        Args:
            view: camera and moment.

        Returns:
            By track id, [H, W] true where any sample of the pixel meets the actor; only those that are visible.
        """
        hits, _ = self._cast_pixels(view, self._samples)
        # The ray-caster counts the actors' faces in the layout's order, after those of what stands.
        counts = [sum(len(part.mesh) for part in actor.parts) for actor in self.layout.actors]
        ends = len(self.layout.static) + np.cumsum([0, *counts])
        numbers = np.searchsorted(ends, hits.face, side="right") - 1
        per_pixel = numbers.reshape(view.lens.height_px, view.lens.width_px, -1)
        visible = np.unique(numbers[numbers >= 0])
        return {self.layout.actors[k].name: (per_pixel == k).any(2) for k in visible}

    def find_background(self, view: TruthView) -> tuple[Float64, NDArray[np.bool_]]:
        """Finds what stands, or the sky, in the middle of each pixel.

        Args:
            view: camera and moment.

        Returns:
            Points [H, W, 3] in the world, those of the sky 10 km away, and whether the pixel shows no actor [H, W].
        """
        hits, directions = self._cast_pixels(view, 1)
        distance_m = np.where(hits.face >= 0, hits.distance_m, _SKY_M).astype(np.float64)
        points = view.world_SE3_camera[:3, 3] + directions * distance_m[:, None]
        size = (view.lens.height_px, view.lens.width_px)
        is_still = (hits.face < len(self.layout.static)).reshape(size)
        return points.reshape(*size, 3), is_still

    def find_recorded_points(self, points: Float64, views: Sequence[TruthView]) -> NDArray[np.bool_]:
        """Finds which points at least one camera sees, with nothing in between.

        Args:
            points: [..., 3] in the world, of what stands or of the sky.
            views: cameras and moments.

        Returns:
            [...] true where a camera has the point in its image, and the ray to it is free.
        """
        flat = points.reshape(-1, 3)
        recorded = np.zeros(len(flat), bool)
        for view in views:
            todo = np.flatnonzero(~recorded)
            inside = todo[_is_in_image(flat[todo], view)]
            if not len(inside):
                continue
            pose = self._to_street(view.world_SE3_camera)
            rays = flat[inside] - view.world_SE3_camera[:3, 3]
            distance_m = np.linalg.norm(rays, axis=1)
            hits = self._caster.cast(pose[:3, 3], rays / distance_m[:, None], view.moment * FRAME_S)
            recorded[inside] = hits.distance_m > _FREE_SHARE * distance_m - _FREE_M
        return recorded.reshape(points.shape[:-1])

    def _cast_pixels(self, view: TruthView, samples: int) -> tuple[Hits, Float64]:
        """Hits of the rays through the pixels, and their unit directions in the world."""
        pose = self._to_street(view.world_SE3_camera)
        directions = camera_rays(view.lens, samples) @ pose[:3, :3].T
        return self._caster.cast(pose[:3, 3], directions, view.moment * FRAME_S), directions

    def _to_street(self, world_SE3_camera: Float64) -> Float64:
        # In a copy: the caller's pose stays.
        pose = np.array(world_SE3_camera, np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            problem = f"expected a finite pose of shape (4, 4), got shape {pose.shape}"
            raise InputError(problem, remedy="Check where the viewpoint comes from.")
        pose[:3, 3] -= self._offset_m
        return pose


def _is_in_image(points: Float64, view: TruthView) -> NDArray[np.bool_]:
    """Whether points [n, 3] of the world are in front of a camera and within its image, distortion left out."""
    local = (points - view.world_SE3_camera[:3, 3]) @ view.world_SE3_camera[:3, :3]
    depth = np.maximum(local[:, 2], 1e-6)
    u = local[:, 0] / depth * view.lens.fx_px + view.lens.cx_px
    v = local[:, 1] / depth * view.lens.fy_px + view.lens.cy_px
    inside = (u >= 0) & (u < view.lens.width_px) & (v >= 0) & (v < view.lens.height_px)
    return np.asarray(inside & (local[:, 2] > 0))


def find_changed_pixels(before: EditedStreet, after: EditedStreet, view: TruthView) -> NDArray[np.bool_]:
    """Finds where an edit changes the true image: actors, and the shadows that they cast.

    Args:
        before: the street before the edit.
        after: the same street after it.
        view: camera and moment.

    Returns:
        [H, W] true where any of red, green and blue differs.
    """
    return np.asarray((before.image(view) != after.image(view)).any(2))
