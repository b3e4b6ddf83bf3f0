"""Training of FNet: its pairs, the network, its numbers on validation seeds. What `genre train` calls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flows.train.thinned import ThinnedLog
from genre_tasks.config import IngestConfig, InitialConfig, OptimiserConfig
from genre_tasks.errors import ConfigError
from genre_tasks.progress import Progress, silent

if TYPE_CHECKING:
    import torch

    from genre_tasks.fixer.network import Fnet
    from genre_tasks.fixer.pairs import Pairs
    from genre_tasks.fixer.training import TrainingSettings
    from genre_tasks.scene.chunk import Chunk
    from genre_tasks.scene.graph import SceneGraph
    from genre_tasks.scene.views import NovelView

TRAINING_SEEDS = range(0, 900)
VALIDATION_SEEDS = range(900, 1000)
"""Seeds of the synthetic street (configs/seeds.yaml): no other may be used to train or to tune."""

SHIFTS_M = (1.0, 2.0, 3.0, 3.0, 3.0, 4.0, 5.0)
"""Lateral shifts of training pairs, drawn with a random sign: fixing is done at 3 m, so it is drawn most."""

ITERATIONS = 24


@dataclass(frozen=True)
class PairSettings:
    """How pairs are made. A log gives ``optimised`` + ``underfitted`` + ``perturbed`` pairs."""

    width_px: int = 320
    height_px: int = 180
    optimised: int = 14
    underfitted: int = 8
    perturbed: int = 6
    real_every: tuple[int, ...] = (4, 10)


@dataclass(frozen=True)
class Scores:
    """Means over views at 3 m of validation seeds: render against truth, fixed against truth."""

    views: int
    psnr_render: float
    psnr_fixed: float
    perceptual_render: float
    perceptual_fixed: float
    psnr_identity: float


def make_pairs(
    folder: Path,
    seeds: Sequence[int],
    settings: PairSettings = PairSettings(),
    real: str | None = None,
    progress: Progress = silent,
) -> list[Path]:
    """One file of pairs per training seed of the synthetic street, and one per sparsity of a real log's chunk 0.

    Files that exist are left: an interrupted run goes on where it was. Raises ``ConfigError`` for other seeds.
    """
    from genre_tasks.fixer.pairs import save_pairs

    stray = [s for s in seeds if s not in TRAINING_SEEDS]
    if stray:
        raise ConfigError(
            f"seeds {stray} are not for training", remedy=f"Use seeds {TRAINING_SEEDS[0]} to {TRAINING_SEEDS[-1]}."
        )
    jobs: list[tuple[Path, Callable[[], Pairs]]] = []
    for seed in seeds:
        jobs.append((folder / f"street-{seed:04d}.npz", lambda seed=seed: street_pairs(seed, settings)))  # type: ignore[misc]
    for every in settings.real_every if real is not None else ():
        jobs.append((folder / f"real-{every:02d}.npz", lambda every=every: real_pairs(str(real), every, settings)))  # type: ignore[misc]
    for done, (path, make) in enumerate(jobs):
        progress(done, len(jobs), path.stem)
        if not path.exists():
            save_pairs(make(), path)
    progress(len(jobs), len(jobs), "pairs")
    return [path for path, _ in jobs]


def street_pairs(seed: int, settings: PairSettings) -> Pairs:
    """Pairs beside the path of one synthetic street: from an optimised, an under-trained and a perturbed scene."""
    import torch

    from genre_tasks.fixer.pairs import perturbed
    from genre_tasks.logs.registry import open_log

    rng = np.random.default_rng(seed)
    log = ThinnedLog(open_log(f"synthetic:street?seed={seed}"), 4)
    points = (20_000, 40_000)[seed % 2]
    chunk, scenes = _optimised(log, settings, 4, points, seed)
    ages = sorted(k for k in scenes if k < ITERATIONS)
    young = scenes[ages[int(rng.integers(len(ages)))]]
    worse = perturbed(scenes[ITERATIONS], torch.Generator().manual_seed(seed), float(rng.uniform(0.3, 1.0)))
    parts = []
    for scene, count in (
        (scenes[ITERATIONS], settings.optimised), (young, settings.underfitted), (worse, settings.perturbed),
    ):  # fmt: skip
        parts.append(_beside(log, chunk, scene, count, 2 * points, rng))
    return joined(parts)


def validation_pairs(seeds: Sequence[int], settings: PairSettings, views: int = 10) -> Pairs:
    """Pairs at ± 3 m of validation seeds, from fully optimised scenes; held in memory only."""
    from genre_tasks.logs.registry import open_log

    parts = []
    for seed in seeds:
        log = ThinnedLog(open_log(f"synthetic:street?seed={seed}"), 4)
        chunk, scenes = _optimised(log, settings, 4, 20_000, seed)
        rng = np.random.default_rng(seed)
        parts.append(_beside(log, chunk, scenes[ITERATIONS], views, 40_000, rng, shifts=(3.0,)))
    return joined(parts)


def real_pairs(uri: str, source_every: int, settings: PairSettings) -> Pairs:
    """Pairs at the held-out frames of a real log's chunk 0, from a reconstruction of every n-th frame.

    Chunk 0 only: the others are for claims.
    """
    from genre_tasks.fixer.pairs import render_pairs
    from genre_tasks.logs.registry import open_log
    from genre_tasks.scene.images import decode_pixels
    from genre_tasks.scene.novel import nearest_reference
    from genre_tasks.scene.views import NovelView

    chunk, scenes = _optimised(open_log(uri), settings, source_every, 40_000, source_every)
    sources = chunk.of_role("source")
    views, truth = [], []
    for view in chunk.of_role("heldout"):
        near = nearest_reference(view.camera, view.chunk_SE3_camera, sources)
        reference = (near.camera, near.frame)
        views.append(NovelView(view.camera, view.frame, 0.0, view.chunk_SE3_camera, view.lens, reference))
        truth.append(decode_pixels(view.image, view.lens.width_px, view.lens.height_px))
    return render_pairs(chunk, scenes[ITERATIONS], views, truth, 60_000)


def train_fnet(
    pairs: Sequence[Path],
    folder: Path,
    settings: TrainingSettings | None = None,
    validation: Pairs | None = None,
    progress: Progress = silent,
    start: Path | None = None,
) -> Path:
    """Trains the small fixer on files of pairs; writes ``fnet.safetensors`` and ``fnet.json`` into ``folder``.

    Resumes from the checkpoints in ``folder``; with ``validation`` a sample picture (render | fixed | truth) is written
    at each of them. ``start``: weights to train further instead of beginning with the autoencoder.
    """
    from genre_tasks.fixer.pairs import load_pairs
    from genre_tasks.fixer.training import TrainingSettings, train
    from genre_tasks.fixer.weights import load_fnet, save_fnet
    from genre_tasks.metrics.perceptual import CHEAP_TAPS, perceptual_distance

    def checkpoint(fnet: Fnet, step: int) -> None:
        save_fnet(fnet, folder / "fnet.safetensors")
        if validation is not None:
            save_picture(fnet, validation, folder / f"sample-{step:06d}.png")

    settings = settings or TrainingSettings()
    fixer = None if start is None else load_fnet(start)
    train(load_pairs(pairs), settings, folder, perceptual_distance(CHEAP_TAPS), progress, checkpoint, start=fixer)
    return folder / "fnet.safetensors"


def score(fnet: Fnet, pairs: Pairs, seed: int = 0) -> Scores:
    """PSNR and perceptual distance to the truth, before and after fixing; and PSNR of a clean image that is fixed."""
    from genre_tasks.fixer.inference import fix, noise_of
    from genre_tasks.metrics.perceptual import perceptual_distance

    distance = perceptual_distance()
    rows = []
    for k in range(len(pairs)):
        views, truth = pairs.at(slice(k, k + 1))
        noise = noise_of(fnet, seed, range(k, k + 1), *truth.shape[-2:])
        clean = replace(views, color=truth, alpha=views.alpha * 0 + 1)
        fixed, same = fix(fnet, views, noise), fix(fnet, clean, noise)
        last = [x.permute(0, 2, 3, 1) for x in (views.color, fixed, truth)]
        rows.append(
            [_psnr(views.color, truth), _psnr(fixed, truth), float(distance(last[0], last[2])),
             float(distance(last[1], last[2])), _psnr(same, truth)]
        )  # fmt: skip
    return Scores(len(pairs), *(float(x) for x in np.mean(rows, 0)))


def save_picture(fnet: Fnet, pairs: Pairs, path: Path, rows: int = 6, seed: int = 0) -> None:
    """A picture of some pairs: render | LiDAR map | the two warps of the reference | fixed | truth."""
    import torch
    from PIL import Image

    from genre_tasks.fixer.inference import fix, noise_of

    lines = []
    for k in np.linspace(0, len(pairs) - 1, min(rows, len(pairs))).astype(int).tolist():
        views, truth = pairs.at(slice(k, k + 1))
        fixed = fix(fnet, views, noise_of(fnet, seed, range(k, k + 1), *truth.shape[-2:]))
        lines.append(torch.cat([views.color, views.lidar_color, views.warped, views.lidar_warped, fixed, truth], -1))
    image = (torch.cat(lines, -2)[0].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
    Image.fromarray(image).save(path)


def joined(parts: Sequence[Pairs]) -> Pairs:
    """All pairs in one, in order."""
    import torch

    from genre_tasks.fixer.conditioning import Degraded
    from genre_tasks.fixer.pairs import NAMES, Pairs

    views = Degraded(*(torch.cat([getattr(p.views, n) for p in parts]) for n in NAMES))
    return Pairs(views, torch.cat([p.truth for p in parts]), np.concatenate([p.shift_m for p in parts]))


def _optimised(
    log: Any, settings: PairSettings, source_every: int, max_points: int, seed: int
) -> tuple[Chunk, dict[int, SceneGraph]]:
    """Chunk 0 and its scene after several numbers of iterations of tuned Adam, the last at ``ITERATIONS``."""
    from genre_tasks.stages.gnet import gnet
    from genre_tasks.stages.ingest import ingest
    from genre_tasks.stages.initial import initial

    size = {"width_px": settings.width_px, "height_px": settings.height_px}
    chunk = ingest(IngestConfig(source_every=source_every, **size), log, 0)
    start = initial(InitialConfig(max_points=max_points, distant_count=max_points // 10), chunk)
    config = OptimiserConfig(method="adam", iterations=ITERATIONS, snapshots=6, seed=seed)
    result = gnet(config, chunk, start)
    return chunk, {**result.snapshots, ITERATIONS: result.scene}


def _beside(
    log: Any,
    chunk: Chunk,
    scene: SceneGraph,
    count: int,
    lidar_max_points: int,
    rng: np.random.Generator,
    shifts: Sequence[float] = SHIFTS_M,
) -> Pairs:
    """Pairs at ``count`` random source poses, each shifted to a random side, with the ray-cast truth."""
    from genre_tasks.fixer.pairs import render_pairs
    from genre_tasks.scene.novel import novel_view_poses

    views: list[NovelView] = []
    for _ in range(count):
        shift = float(rng.choice(shifts) * rng.choice((-1, 1)))
        poses = novel_view_poses(chunk, (shift,))
        views.append(poses[int(rng.integers(len(poses)))])
    truth = [log.truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
    return render_pairs(chunk, scene, views, truth, lidar_max_points)


def _psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    return float(-10 * (a - b).square().mean().clamp_min(1e-10).log10())
