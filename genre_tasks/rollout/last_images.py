"""The fixed images of the pose before, as one more image that the fixer looks pixels up in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.view_surface import MIN_ALPHA, unproject_surface
from genre_tasks.fixer.warping import SourceImage, sample_source
from genre_tasks.logs.types import Float64
from genre_tasks.rollout.moment_actors import LAST_MOMENT, THIS_MOMENT
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.chunk import Actor
from genre_tasks.scene.novel_views import NovelViews
from genre_tasks.scene.transforms import invert_se3


@dataclass(frozen=True)
class LastImage:
    """The fixed image of a camera, with what hides points from it.

    Attributes:
        index: of the pose.
        view: where the camera was.
        world_SE3_camera: [4, 4]; the next pose may be in another chunk.
        image: [3, H, W].
        depth: [H, W] metres, 0 where unknown.
    """

    index: int
    view: RolloutView
    world_SE3_camera: Float64
    image: Tensor
    depth: Tensor


class LastImages:
    """The last fixed image of each camera."""

    def __init__(self) -> None:
        self._images: dict[str, LastImage] = {}

    def remember(self, images: RolloutImages, color: Tensor) -> None:
        """Replaces the images by those of a pose.

        Args:
            images: of the pose; their depth says what hides points.
            color: [C, H, W, 3] fixed.
        """
        depth = torch.where(images.alpha >= MIN_ALPHA, images.depth, torch.zeros_like(images.depth))
        world_SE3_chunk = images.chunk_scene.chunk.world_SE3_chunk
        self._images = {
            view.camera: LastImage(
                index=images.index,
                view=view,
                world_SE3_camera=world_SE3_chunk @ view.chunk_SE3_camera,
                image=color[k].permute(2, 0, 1),
                depth=depth[k],
            )
            for k, view in enumerate(images.views)
        }

    def find_frame(self, index: int) -> float | None:
        """Finds the moment of the images that a pose follows.

        Args:
            index: of the pose.

        Returns:
            Log frame, or a moment between two; ``None`` where there are no images of the pose before.
        """
        followed = [last for last in self._images.values() if last.index == index - 1]
        # All cameras of a pose are of one moment.
        return followed[0].view.frame if followed else None

    def look_up(
        self,
        images: RolloutImages,
        novel: NovelViews,
        rows: Sequence[int],
        actors: Sequence[Actor],
        inputs: FixerInputs,
    ) -> FixerInputs:
        """Looks pixels up in the images of the pose before, where no recorded image shows their points.

        Args:
            images: of this pose.
            novel: its views as the fixer reads them.
            rows: B views that ``inputs`` are of.
            actors: with poses at both moments.
            inputs: what the views are fixed from.

        Returns:
            The inputs with more of ``warped`` known; the same where no image is of the pose before.
        """
        chunk_SE3_world = invert_se3(images.chunk_scene.chunk.world_SE3_chunk)
        color = inputs.warped.clone()
        mask = inputs.warp_mask.clone()
        for j, k in enumerate(rows):
            view = novel.views[k]
            last = self._images.get(view.camera)
            if last is None or last.index != images.index - 1:
                continue
            source = SourceImage(
                camera=view.camera,
                frame=LAST_MOMENT,
                chunk_SE3_camera=chunk_SE3_world @ last.world_SE3_camera,
                lens=last.view.lens,
                image=last.image,
                depth=last.depth,
            )
            surface = unproject_surface(
                novel.depth[k], novel.alpha[k], view.chunk_SE3_camera, view.lens, actors, THIS_MOMENT
            )
            sampled, visible = sample_source(surface, source, actors, THIS_MOMENT)
            # Behind and not before recorded images: what is resampled from pose to pose blurs ever more.
            color[j] = torch.where(visible & (mask[j, 0] < 0.5), sampled, color[j])
            mask[j] = torch.maximum(mask[j], visible[None].to(mask))
        return replace(inputs, warped=color, warp_mask=mask)
