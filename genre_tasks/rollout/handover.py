"""Hand-over between chunks: where along a path the scene of one chunk fades into that of the next."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.types import Float64
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.camera_motion import place_rollout_views
from genre_tasks.rollout.chunk_layout import ChunkLayout, lay_out_chunks
from genre_tasks.rollout.rig import RigCamera
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource

DEFAULT_SETTINGS = RenderSettings()

CANDIDATE_OFFSETS = (0.0, -2.0, 2.0, -4.0, 4.0)
"""Log frames from the border at which the seam is measured; the border first, which equal seams are decided for."""


@dataclass(frozen=True)
class Handover:
    """A fade from the background of one chunk to that of the next.

    Places on the recorded path are named by the log frame at which the recorded vehicle was there.

    Attributes:
        before: number of the chunk that is left.
        after: number of the chunk that is entered.
        border_frame: the place between the last frame of ``before`` and the first of ``after``.
        start_frame: until there the scene of ``before`` is shown alone.
        end_frame: from there on that of ``after`` alone; equal to ``start_frame`` for a cut.
        psnr_db: how alike both scenes show the same views in the middle, without actors; NaN where not measured.
        candidates: (log frame, PSNR in dB) of each moment that was compared.
    """

    before: int
    after: int
    border_frame: float
    start_frame: float
    end_frame: float
    psnr_db: float = math.nan
    candidates: tuple[tuple[float, float], ...] = ()

    def weigh(self, place: float) -> float:
        """Gives how much the scene of ``after`` counts at a place.

        Args:
            place: log frame, or a moment between two, at which the recorded vehicle was there.

        Returns:
            0 to 1, linear in the place.

        >>> fade = Handover(before=0, after=1, border_frame=19.5, start_frame=17.0, end_frame=22.0)
        >>> [fade.weigh(place) for place in (16, 19.5, 23)]
        [0.0, 0.5, 1.0]
        """
        return _ramp(place, self.start_frame, self.end_frame)

    def weigh_traffic(self, frame: float) -> float:
        """Gives how much the actors of ``after`` count at a moment, where both chunks have Gaussians of them.

        Their fade takes as long as that of the background, and is centred on the border.

        Args:
            frame: log frame, or a moment between two.

        Returns:
            0 to 1, linear in the moment.
        """
        half = (self.end_frame - self.start_frame) / 2
        return _ramp(frame, self.border_frame - half, self.border_frame + half)


def plan_handovers(
    source: SceneSource,
    path: EgoPath,
    rig: Sequence[RigCamera],
    handover_frames: float,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> tuple[Handover, ...]:
    """Finds for every border between chunks the place at which both scenes look most alike from the path.

    Args:
        source: the scenes of a run.
        path: P poses.
        rig: the cameras.
        handover_frames: length of a fade, in frames of the recorded drive; 0: a cut. Short chunks have shorter fades.
        settings: backend and threads.

    Returns:
        One hand-over for each two chunks that follow each other, in their order.
    """
    layout = lay_out_chunks(source)
    places = layout.find_places(path)
    handovers = []
    for cut in cut_at_borders(layout):
        before = source.load(cut.before)
        after = source.load(cut.after)
        # Within half of each chunk, so that no place belongs to two hand-overs.
        room = min(len(before.chunk.frames), len(after.chunk.frames)) / 2
        half = min(handover_frames / 2, room)
        middles = [cut.border_frame + offset for offset in CANDIDATE_OFFSETS if abs(offset) + half <= room]
        poses = _find_poses(places, middles)
        candidates = _measure_candidates((before, after), path, rig, poses, settings)
        middle, best_db = max(candidates, key=lambda candidate: candidate[1], default=(cut.border_frame, math.nan))
        handovers.append(
            replace(cut, start_frame=middle - half, end_frame=middle + half, psnr_db=best_db, candidates=candidates)
        )
    return tuple(handovers)


def cut_at_borders(layout: ChunkLayout) -> tuple[Handover, ...]:
    """Gives the hand-overs of a rollout without any fade: each chunk is shown at its places.

    Args:
        layout: of the run's chunks.

    Returns:
        One cut for each two chunks that follow each other.
    """
    spans = zip(layout.numbers, layout.first_frames, layout.last_frames, strict=True)
    cuts = []
    for (before, _, last), (after, first, _) in itertools.pairwise(spans):
        border = (last + first) / 2
        cuts.append(Handover(before, after, border_frame=border, start_frame=border, end_frame=border))
    return tuple(cuts)


def _ramp(value: float, start: float, end: float) -> float:
    if end <= start:
        return float(value >= end)
    return min(max((value - start) / (end - start), 0.0), 1.0)


def _find_poses(places: Float64, middles: Sequence[float]) -> dict[float, int]:
    """The pose nearest to each place; none where the path does not reach the border, which is the first of them."""
    if not len(places) or not places.min() < middles[0] < places.max():
        return {}
    nearest = {middle: int(np.abs(places - middle).argmin()) for middle in middles}
    return {middle: index for middle, index in nearest.items() if abs(places[index] - middle) <= 1}


def _measure_candidates(
    scenes: tuple[ChunkScene, ChunkScene],
    path: EgoPath,
    rig: Sequence[RigCamera],
    poses: Mapping[float, int],
    settings: RenderSettings,
) -> tuple[tuple[float, float], ...]:
    """(place, PSNR in dB between the two scenes' renders of the same views) of each pose."""
    without_traffic = [replace(scene, scene=_remove_actors(scene.scene)) for scene in scenes]
    measured = []
    for place, index in poses.items():
        images = [_render_sharp(scene, path, index, rig, settings) for scene in without_traffic]
        measured.append((place, psnr(images[0].flatten(0, 1).numpy(), images[1].flatten(0, 1).numpy())))
    return tuple(measured)


def _render_sharp(
    chunk_scene: ChunkScene, path: EgoPath, index: int, rig: Sequence[RigCamera], settings: RenderSettings
) -> Tensor:
    # [C, H, W, 3]. Neither scene has motion blur here: a blurred seam would look smaller.
    views = [replace(v, shutter=None, blur=None) for v in place_rollout_views(path, index, rig, chunk_scene)]
    with torch.no_grad():
        return render_views(chunk_scene.scene, views, settings).color.clamp(0, 1).cpu()


def _remove_actors(scene: SceneGraph) -> SceneGraph:
    rows = torch.nonzero(scene.nodes < FIRST_ACTOR)[:, 0]
    harmonics = scene.spherical_harmonics
    return replace(
        scene,
        gaussians=map_attributes(lambda x: x[rows], scene.gaussians),
        nodes=scene.nodes[rows],
        actors=(),
        deformation=None,
        spherical_harmonics=None if harmonics is None else harmonics[rows],
    )
