"""Runs FNet over a rollout: all of its images, or what removed actors hid alone."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from genre_tasks.checks import check_finite
from genre_tasks.config import FnetConfig
from genre_tasks.errors import InputError
from genre_tasks.fixer.inference import draw_noise, encode_reference, find_reduction, fix, prefers_bfloat16
from genre_tasks.fixer.inputs import build_inputs
from genre_tasks.fixer.network import Encoded, Fnet
from genre_tasks.fixer.source_images import load_source_images
from genre_tasks.fixer.view_surface import MIN_ALPHA
from genre_tasks.render import Render, RenderSettings, render_views
from genre_tasks.render.surface import render_surfaces
from genre_tasks.rollout.background_repair import repair_background
from genre_tasks.rollout.last_images import LastImages
from genre_tasks.rollout.moment_actors import LAST_MOMENT, THIS_MOMENT, pose_actors
from genre_tasks.rollout.removed_area import (
    RemovedActors,
    find_uncovered_area,
    separate_removed_actors,
)
from genre_tasks.rollout.render_rollout import RolloutImages
from genre_tasks.scene.chunk import Actor, Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.lidar_map import build_lidar_scene
from genre_tasks.scene.novel_poses import find_nearest_reference
from genre_tasks.scene.novel_views import NovelView, NovelViews
from genre_tasks.scene_edits.chunk_scene import CHUNKS_IN_MEMORY, SceneSource
from genre_tasks.stages.fnet import load_configured_fnet
from genre_tasks.threads import map_single_threaded

DEFAULT_SETTINGS = RenderSettings()


@dataclass(frozen=True)
class FixedRolloutImages:
    """What the fixer makes of the images of one pose.

    Attributes:
        color: [C, H, W, 3] sRGB in [0, 1].
        filled: [C, H, W] true where a removed actor hid what no recorded image shows: FNet drew it.
        alpha: [C, H, W] opacity in [0, 1]: 1 where FNet drew, else the render's.
        depth: [C, H, W] metres, 0 where unknown: the render's, and where ``filled`` that of the background.
    """

    color: Tensor
    filled: Tensor
    alpha: Tensor
    depth: Tensor


@dataclass(frozen=True)
class _ChunkImages:
    """What the fixer reads of a chunk: recorded images, and the LiDAR map's scene.

    Attributes:
        chunk: as edited.
        removed: actors that were removed, and the recorded images without them.
        repaired: the edited scene, repaired where removed actors hid the background.
        lidar_scene: coloured points as discs, as edited.
        latents: of references by camera and frame, once encoded.
    """

    chunk: Chunk
    removed: RemovedActors
    repaired: SceneGraph
    lidar_scene: SceneGraph
    latents: dict[tuple[str, int], Tensor] = field(default_factory=dict)


class RolloutFixer:
    """Repairs the images of a rollout, pose after pose.

    A camera has the same noise at every pose, so that the noise does not flicker. With ``config.temporal`` the fixed
    image of the pose before, warped by rendered depth, is one more looked-up image.

    Args:
        config: which network, and how it runs.
        recorded: the scenes as recorded, without edits: recorded images show what was edited away.
        lidar_max_points: points drawn in the LiDAR map.
        network: at hand; ``None``: loaded as ``config`` says.
        settings: of the renderer.

    Raises:
        InputError: the weights are missing or do not fit.
    """

    def __init__(
        self,
        config: FnetConfig,
        recorded: SceneSource,
        lidar_max_points: int,
        network: Fnet | None = None,
        settings: RenderSettings = DEFAULT_SETTINGS,
    ) -> None:
        self._config = config
        self._recorded = recorded
        self._lidar_max_points = lidar_max_points
        self._network = load_configured_fnet(config) if network is None else network
        self._settings = settings
        self._chunks: OrderedDict[int, _ChunkImages] = OrderedDict()
        self._last = LastImages()

    @torch.no_grad()
    def fix(self, images: RolloutImages) -> FixedRolloutImages:
        """Repairs all images of a pose.

        Args:
            images: of the pose; poses follow each other in order.

        Returns:
            The fixed images, and where they show what removed actors hid.

        Raises:
            NonFiniteError: a render is not finite.
        """
        chunk_images = self._load_chunk(images)
        novel = self._render_inputs(images, chunk_images)
        novel, filled = self._paste_repaired(images, novel, chunk_images)
        color = self._run_network(images, novel, chunk_images, range(len(images.views)))
        depth = _fill_depth(images, novel, filled)
        self._remember(images, color, depth, filled)
        return FixedRolloutImages(color, filled, torch.ones_like(images.alpha), depth)

    @torch.no_grad()
    def fill(self, images: RolloutImages) -> FixedRolloutImages:
        """Fills what removed actors hid; all other pixels stay those of the render.

        Args:
            images: of the pose.

        Returns:
            The images, and the pixels that were filled.

        Raises:
            NonFiniteError: a render is not finite.
        """
        nowhere = torch.zeros_like(images.alpha, dtype=torch.bool)
        if not images.chunk_scene.removed:
            return FixedRolloutImages(images.color, nowhere, images.alpha, images.depth)
        chunk_images = self._load_chunk(images)
        novel = self._render_inputs(images, chunk_images)
        novel, filled = self._paste_repaired(images, novel, chunk_images)
        rows = [k for k in range(len(images.views)) if bool(filled[k].any())]
        color = images.color.clone()
        if rows:
            # The network repairs a view in one piece, and only the uncovered pixels are taken.
            fixed = self._run_network(images, novel, chunk_images, rows)
            color[rows] = torch.where(filled[rows][..., None], fixed, color[rows])
        depth = _fill_depth(images, novel, filled)
        self._remember(images, color, depth, filled)
        return FixedRolloutImages(color, filled, images.alpha.masked_fill(filled, 1.0), depth)

    def _remember(self, images: RolloutImages, color: Tensor, depth: Tensor, filled: Tensor) -> None:
        # With the depth of a hole, the next pose would find nothing of what was filled.
        shown = replace(images, alpha=images.alpha.masked_fill(filled, 1.0), depth=depth)
        self._last.remember(shown, color)

    def _load_chunk(self, images: RolloutImages) -> _ChunkImages:
        chunk = images.chunk_scene.chunk
        known = self._chunks.get(chunk.index)
        # An edit that changes along the path gives another chunk of the same index.
        if known is None or known.chunk is not chunk:
            recorded = self._recorded.load(chunk.index)
            views = recorded.chunk.views_with_role("source")
            if not views:
                raise InputError(
                    "the chunk has no source image to fix views from",
                    remedy="Reconstruct it from a log with images.",
                    log=chunk.log,
                    chunk=chunk.index,
                )
            removed = separate_removed_actors(
                scene=recorded.scene,
                removed=images.chunk_scene.removed,
                sources=load_source_images(recorded.chunk),
                # Depth has no motion blur, and without it each view is rendered once.
                views=[replace(view, blur=None) for view in views],
                settings=self._settings,
            )
            scene = images.chunk_scene.scene
            if images.chunk_scene.removed:
                scene = repair_background(scene, chunk, images.chunk_scene.removed, removed)
            known = _ChunkImages(chunk, removed, scene, build_lidar_scene(chunk, self._lidar_max_points))
            self._chunks[chunk.index] = known
        self._chunks.move_to_end(chunk.index)
        while len(self._chunks) > CHUNKS_IN_MEMORY:
            self._chunks.popitem(last=False)
        return known

    def _render_inputs(self, images: RolloutImages, chunk_images: _ChunkImages) -> NovelViews:
        """Renders the LiDAR map at the views, and puts it beside the render."""
        lidar = render_surfaces(chunk_images.lidar_scene, images.views, self._settings)
        check_finite(lidar.color, "LiDAR map", "fnet", chunk=chunk_images.chunk.index)
        references = chunk_images.chunk.views_with_role("source")
        views = []
        for view in images.views:
            nearest = find_nearest_reference(view.camera, view.chunk_SE3_camera, references)
            reference = (nearest.camera, nearest.frame)
            views.append(NovelView(view.camera, THIS_MOMENT, 0.0, view.chunk_SE3_camera, view.lens, reference))
        return NovelViews(
            views=tuple(views),
            color=images.color,
            alpha=images.alpha,
            depth=images.depth,
            lidar_color=lidar.color,
            lidar_alpha=lidar.alpha,
            lidar_depth=lidar.expected_depth(),
        )

    def _find_area(self, images: RolloutImages, novel: NovelViews, chunk_images: _ChunkImages) -> Tensor:
        if not images.chunk_scene.removed:
            return torch.zeros_like(images.alpha, dtype=torch.bool)
        return find_uncovered_area(images, _find_depth(novel), chunk_images.removed, self._settings)

    def _paste_repaired(
        self, images: RolloutImages, novel: NovelViews, chunk_images: _ChunkImages
    ) -> tuple[NovelViews, Tensor]:
        """The views with what the repaired scene shows where removed actors were, and where that is."""
        uncovered = self._find_area(images, novel, chunk_images)
        if not bool(uncovered.any()):
            return novel, uncovered
        repaired = render_views(chunk_images.repaired, images.views, self._settings)
        return _paste(novel, uncovered, repaired), uncovered

    def _run_network(
        self, images: RolloutImages, novel: NovelViews, chunk_images: _ChunkImages, rows: Sequence[int]
    ) -> Tensor:
        """[V, H, W, 3] fixed images of some of the views."""
        rows = list(rows)
        moving = self._pose_actors(images, chunk_images)
        names = chunk_images.chunk.camera_names
        half = prefers_bfloat16(novel.color.device) if self._config.half is None else self._config.half
        height, width = novel.alpha.shape[1:]
        reduction = find_reduction(self._config.max_network_px, height, width)
        latents = {k: self._encode_reference(novel.views[k].reference, chunk_images) for k in rows}
        # The fixer finds actors' poses in a chunk: one whose actors are where they are at this moment.
        chunk = replace(chunk_images.chunk, actors=moving)

        def fix_batch(batch: Sequence[int]) -> Tensor:
            inputs = build_inputs(chunk, novel, batch, chunk_images.removed.sources)
            if self._config.temporal:
                inputs = self._last.look_up(images, novel, batch, moving, inputs)
            # By camera and not by pose: noise that changes from pose to pose is seen as flicker.
            seeds = [names.index(images.views[k].camera) for k in batch]
            noise = draw_noise(self._network, self._config.seed, seeds, height, width, reduction)
            references = Encoded(torch.cat([latents[k] for k in batch]), ())
            return fix(self._network, inputs, noise, references, half, reduction=reduction)

        size = self._config.batch_views
        batches = [rows[first : first + size] for first in range(0, len(rows), size)]
        return torch.cat(map_single_threaded(fix_batch, batches)).permute(0, 2, 3, 1)

    def _pose_actors(self, images: RolloutImages, chunk_images: _ChunkImages) -> tuple[Actor, ...]:
        moments = {THIS_MOMENT: images.views[0].frame}
        last_frame = self._last.find_frame(images.index)
        if last_frame is not None:
            moments[LAST_MOMENT] = last_frame
        recorded = {actor.track_id: actor for actor in chunk_images.removed.recorded}
        frames = sorted({source.frame for source in chunk_images.removed.sources})
        return pose_actors(images.chunk_scene.scene.actors, moments, recorded, frames)

    def _encode_reference(self, reference: tuple[str, int], chunk_images: _ChunkImages) -> Tensor:
        if reference not in chunk_images.latents:
            image = next(s.image for s in chunk_images.removed.sources if (s.camera, s.frame) == reference)
            reduction = find_reduction(self._config.max_network_px, *image.shape[1:])
            chunk_images.latents[reference] = encode_reference(self._network, image, reduction).latent
        return chunk_images.latents[reference]


def _find_depth(novel: NovelViews) -> Tensor:
    """[V, H, W] metres by the LiDAR map, and by the scene where LiDAR has nothing; 0 where neither knows."""
    rendered = torch.where(novel.alpha >= MIN_ALPHA, novel.depth, torch.zeros_like(novel.depth))
    return torch.where(novel.lidar_alpha >= MIN_ALPHA, novel.lidar_depth, rendered)


def _fill_depth(images: RolloutImages, novel: NovelViews, filled: Tensor) -> Tensor:
    """The depth of the render, and where the fixer filled a hole that of what ``novel`` shows there."""
    # A render looks through the thin Gaussians of a hole at something behind.
    return torch.where(filled, _find_depth(novel), images.depth)


def _paste(novel: NovelViews, area: Tensor, repaired: Render) -> NovelViews:
    """The views with what another render shows in an area [V, H, W]."""
    color = repaired.color.clamp(0, 1)
    # The LiDAR map has points there without a colour of any image.
    lidar_color = color * novel.lidar_alpha[..., None]
    return replace(
        novel,
        lidar_color=torch.where(area[..., None], lidar_color, novel.lidar_color),
        color=torch.where(area[..., None], color, novel.color),
        alpha=torch.where(area, repaired.alpha, novel.alpha),
        depth=torch.where(area, repaired.expected_depth(), novel.depth),
    )
