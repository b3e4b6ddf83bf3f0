"""Hand-over between chunks: where along a path the scene of one chunk fades into that of the next."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.render import render_views
from genre_tasks.render.types import RenderSettings
from genre_tasks.rollout.camera_motion import place_rollout_views
from genre_tasks.rollout.rig import RigCamera
from genre_tasks.scene.gaussians import map_attributes
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource

DEFAULT_SETTINGS = RenderSettings()

CANDIDATE_OFFSETS = (0.0, -2.0, 2.0, -4.0, 4.0)
"""Log frames from the border at which the seam is measured; the border first, which equal seams are decided for."""


@dataclass(frozen=True)
class Handover:
    """A fade from the scene of one chunk to that of the next.

    Attributes:
        before: number of the chunk that is left.
        after: number of the chunk that is entered.
        border_frame: the moment between the last log frame of the one and the first of the other.
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

    def weigh(self, frame: float) -> float:
        """Gives how much the scene of ``after`` counts at a moment.

        Args:
            frame: log frame, or a moment between two.

        Returns:
            0 to 1, linear in the moment.

        >>> fade = Handover(before=0, after=1, border_frame=19.5, start_frame=17.0, end_frame=22.0)
        >>> [fade.weigh(frame) for frame in (16, 19.5, 23)]
        [0.0, 0.5, 1.0]
        """
        if self.end_frame <= self.start_frame:
            return float(frame >= self.end_frame)
        return min(max((frame - self.start_frame) / (self.end_frame - self.start_frame), 0.0), 1.0)

    def needs_traffic(self, frame: float) -> bool:
        """Tells whether a scene is shown at a moment that only the other chunk has actors of.

        Args:
            frame: log frame, or a moment between two.
        """
        # Actors of a moment are those of the nearest frame, so a half frame on both sides of the border counts too.
        return min(self.start_frame, self.border_frame - 0.5) < frame < max(self.end_frame, self.border_frame + 0.5)


def plan_handovers(
    source: SceneSource,
    path: EgoPath,
    rig: Sequence[RigCamera],
    handover_frames: float,
    settings: RenderSettings = DEFAULT_SETTINGS,
) -> tuple[Handover, ...]:
    """Finds for every border between chunks the moment at which both scenes look most alike from the path.

    Args:
        source: the scenes of a run.
        path: P poses.
        rig: the cameras.
        handover_frames: log frames that a fade takes; 0: a cut. Short chunks have shorter fades.
        settings: backend and threads.

    Returns:
        One hand-over for each two chunks that follow each other, in their order.
    """
    handovers = []
    for cut in cut_at_borders(source):
        before = source.load(cut.before)
        after = source.load(cut.after)
        # Within half of each chunk, so that no moment belongs to two hand-overs.
        room = min(len(before.chunk.frames), len(after.chunk.frames)) / 2
        half = min(handover_frames / 2, room)
        offsets = [offset for offset in CANDIDATE_OFFSETS if abs(offset) + half <= room]
        candidates = _measure_candidates((before, after), path, rig, [cut.border_frame + o for o in offsets], settings)
        middle = cut.border_frame
        best_db = math.nan
        if candidates:
            middle, best_db = max(candidates, key=lambda candidate: candidate[1])
        handovers.append(
            replace(cut, start_frame=middle - half, end_frame=middle + half, psnr_db=best_db, candidates=candidates)
        )
    return tuple(handovers)


def cut_at_borders(source: SceneSource) -> tuple[Handover, ...]:
    """Gives the hand-overs of a rollout without any fade: each chunk is shown at its frames.

    Args:
        source: the scenes of a run.

    Returns:
        One cut for each two chunks that follow each other.
    """
    # Every chunk once, in order: only the last few stay in memory.
    spans = []
    for number in source.chunk_numbers:
        frames = source.load(number).chunk.frames
        spans.append((number, frames[0], frames[-1]))
    cuts = []
    for (before, _, last), (after, first, _) in itertools.pairwise(spans):
        border = (last + first) / 2
        cuts.append(Handover(before, after, border_frame=border, start_frame=border, end_frame=border))
    return tuple(cuts)


def _measure_candidates(
    scenes: tuple[ChunkScene, ChunkScene],
    path: EgoPath,
    rig: Sequence[RigCamera],
    moments: Sequence[float],
    settings: RenderSettings,
) -> tuple[tuple[float, float], ...]:
    """(log frame, PSNR in dB) at the moments at which the path has a pose; none where it stays in one chunk."""
    if not len(path) or not path.frames.min() < moments[0] < path.frames.max():
        return ()
    without_traffic = [replace(scene, scene=_remove_actors(scene.scene)) for scene in scenes]
    measured = []
    for moment in moments:
        index = int(np.abs(path.frames - moment).argmin())
        if abs(path.frames[index] - moment) > 1:
            continue
        images = [_render_sharp(scene, path, index, rig, settings) for scene in without_traffic]
        measured.append((moment, psnr(images[0].flatten(0, 1).numpy(), images[1].flatten(0, 1).numpy())))
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
