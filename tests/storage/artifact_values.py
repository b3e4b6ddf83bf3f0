"""Small values of every kind of artifact, made from a NumPy generator, and their comparison."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from genre_tasks.effects.types import Decision, EffectParameters, EffectsPlan
from genre_tasks.fixer.inputs import FixerInputs
from genre_tasks.fixer.pairs import INPUT_NAMES, Pairs
from genre_tasks.logs.types import Lens, MotionBlur, RollingShutter
from genre_tasks.metrics.results import Evaluation, Metric, ViewScore
from genre_tasks.metrics.scoring import FeatureSet
from genre_tasks.rollout.rollout_scores import RolloutScores
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor, Chunk, LogIssue, Points, Role, View
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene.novel_views import FixedViews, NovelView, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction


def pose(rng: np.random.Generator) -> np.ndarray:
    out = np.eye(4)
    out[:3] = rng.normal(size=(3, 4))
    return out


def lens(rng: np.random.Generator, width: int = 7, height: int = 5) -> Lens:
    distortion = tuple(rng.normal(size=5).tolist()) if rng.random() < 0.5 else ()
    return Lens(*rng.uniform(1, 1000, 4).tolist(), width, height, distortion)


def points(rng: np.random.Generator, count: int) -> Points:
    return Points(
        (rng.normal(size=(count, 3)) * 100).astype(np.float32),
        rng.integers(0, 256, (count, 3), dtype=np.uint8),
        rng.random(count) < 0.5,
        rng.integers(-5, 300, count).astype(np.int16),
    )


def role(frame: int) -> Role:
    return "heldout" if frame % 2 else "source"


def chunk(rng: np.random.Generator, frames: int = 3, actors: int = 2, count: int = 11) -> Chunk:
    names = ("front_camera", "zurück")
    views = tuple(
        View(c, f, role(f), 1.6e9 + float(rng.random()), pose(rng), lens(rng), rng.bytes(int(rng.integers(0, 3000))))
        for f in range(frames)
        for c in names
    )
    issues = (
        LogIssue("missing_sweep", "none", frame=1),
        LogIssue("missing_image", "gone", 2, "zurück"),
        LogIssue("standstill", ""),
    )
    made = []
    for k in range(actors):
        n = int(rng.integers(0, frames + 1))
        poses = np.array([pose(rng) for _ in range(n)]).reshape(-1, 4, 4)
        size = tuple(rng.uniform(0.1, 9, 3).tolist())
        made.append(Actor(f"t{k}", "Car", size, np.arange(n), poses, points(rng, k * count)))
    return Chunk(
        dataset="synthetic",
        log="street-seed=1",
        index=2,
        frames=tuple(range(frames)),
        camera_names=names,
        width_px=7,
        height_px=5,
        world_SE3_chunk=pose(rng),
        chunk_SE3_ego=np.array([pose(rng) for _ in range(frames)]).reshape(-1, 4, 4),
        views=views,
        static=points(rng, count),
        actors=tuple(made),
        log_issues=issues,
    )


def scene(rng: np.random.Generator, count: int = 13, actors: tuple[ActorNode, ...] = ()) -> SceneGraph:
    packed = torch.from_numpy((rng.normal(size=(count, 14)) * 10 ** rng.uniform(-6, 3, (count, 14))).astype(np.float32))
    nodes = torch.from_numpy(rng.integers(0, 2 + len(actors), count))
    return SceneGraph(Gaussians.unpack(packed), nodes, actors)


def reconstruction(rng: np.random.Generator, count: int = 13, actors: int = 2, snapshots: int = 2) -> Reconstruction:
    nodes = tuple(
        ActorNode(f"t{k}", "Car", (4.0, 2.0, 1.5), np.arange(k + 1), np.array([pose(rng) for _ in range(k + 1)]))
        for k in range(actors)
    )
    return Reconstruction(
        scene(rng, count, nodes),
        tuple(rng.random(4).tolist()),
        {8 * (k + 1): scene(rng, count + k, nodes) for k in range(snapshots)},
        tuple(rng.random(4).tolist()),
        {"behind": 3, "non_finite": 0},
    )


def novel_view(rng: np.random.Generator, k: int, width: int = 7, height: int = 5) -> NovelView:
    shift = (3.0, -3.0)[k % 2]
    return NovelView("front_camera", k, shift, pose(rng), lens(rng, width, height), ("back/camera", k + 1))


def novel_views(rng: np.random.Generator, count: int = 2, width: int = 7, height: int = 5) -> NovelViews:
    def layer() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        alpha = rng.random((count, height, width)).astype(np.float32)
        alpha[rng.random(alpha.shape) < 0.2] = 0.0
        alpha[rng.random(alpha.shape) < 0.2] = 1.0
        color = rng.random((count, height, width, 3)).astype(np.float32) * alpha[..., None]
        depth = (10 ** rng.uniform(-3, 6, alpha.shape)).astype(np.float32) * (alpha > 0)
        return torch.from_numpy(color), torch.from_numpy(alpha), torch.from_numpy(depth)

    views = tuple(novel_view(rng, k, width, height) for k in range(count))
    return NovelViews(views, *layer(), *layer(), {"behind": 5}, {"behind": 7, "degenerate": 1})


def fixed_views(rng: np.random.Generator, count: int = 2, width: int = 7, height: int = 5) -> FixedViews:
    color = torch.from_numpy(rng.random((count, height, width, 3)).astype(np.float32))
    views = tuple(novel_view(rng, k, width, height) for k in range(count))
    return FixedViews(views, color, tuple(range(0, count, 2)), 0.5 if count else 0.0)


def pairs(rng: np.random.Generator, count: int = 2, width: int = 7, height: int = 5) -> Pairs:
    def image(channels: int) -> torch.Tensor:
        return torch.from_numpy(rng.integers(0, 256, (count, channels, height, width), dtype=np.uint8))

    colours = ("color", "lidar_color", "reference", "warped", "lidar_warped")
    views = FixerInputs(**{name: image(3 if name in colours else 1) for name in INPUT_NAMES})
    return Pairs(views, image(3), tuple(f"kind {k}" for k in range(count)), rng.random(count).astype(np.float32))


def evaluation(rng: np.random.Generator, count: int = 3) -> Evaluation:
    kernel = [Metric(f"shift_{k}m/kernel", float(rng.random()), k, 0.1, 0.3) for k in range(count)]
    names = [f"{k}m_left_front_camera_04{suffix}" for k in range(count) for suffix in ("", ".truth")]
    return Evaluation(
        "gnet",
        (Metric("interpolation/psnr", float("inf"), 5), *kernel),
        tuple(ViewScore("front_camera", k, 3.0, *rng.random(3).tolist()) for k in range(count)),
        tuple((8 * k, float(rng.random())) for k in range(count)),
        {name: rng.integers(0, 256, (4 + k, 6, 3), dtype=np.uint8) for k, name in enumerate(names)},
    )


def rollout_scores(rng: np.random.Generator, count: int = 3) -> RolloutScores:
    features = torch.from_numpy(rng.normal(size=(count, 5)).astype(np.float32))
    return RolloutScores(
        (Metric("psnr", float(rng.random()), count), Metric("kernel", float(rng.random()), count, 0.1, 0.3)),
        tuple(ViewScore("front_camera", k, 3.0, *rng.random(3).tolist()) for k in range(count)),
        FeatureSet(features, tuple(range(count))),
    )


def effects(rng: np.random.Generator, count: int = 3) -> EffectsPlan:
    rows = [
        Decision(
            f"effect_{k}",
            "a property",
            float(rng.random()),
            "px",
            0.5,
            "auto",
            ("on", "off", "mark")[k % 3],
            "why",
            "cost",
        )
        for k in range(count)
    ]
    own = {f"camera_{k}": rng.random((4, 6)) < 0.5 for k in range(count)}
    gains = {(f"camera_{k}", k): tuple(float(x) for x in rng.normal(size=3)) for k in range(count)}
    numbers = rng.normal(size=(count, 8)).tolist()
    shutters = {
        (f"camera_{k}", k): RollingShutter(
            x[0], velocity_m_s=(x[1], x[2], x[3]), turn_rad_s=(x[4], x[5], x[6]), frame_s=x[7]
        )
        for k, x in enumerate(numbers)
    }
    blurs = {
        (f"camera_{k}", k): MotionBlur(
            x[7], velocity_m_s=(x[1], x[2], x[3]), turn_rad_s=(x[4], x[5], x[6]), frame_s=x[0]
        )
        for k, x in enumerate(numbers)
    }
    stereo_points = points(rng, 7 * count) if count else None
    poses = {(f"camera_{k}", k): rng.normal(size=(4, 4)) for k in range(count)}
    ego_points = np.sort(rng.choice(1000, 5 * count, replace=False)) if count else None
    return EffectsPlan(tuple(rows), EffectParameters(gains, own, shutters, blurs, stereo_points, poses, ego_points))


MAKERS = {
    "chunk": chunk,
    "reconstruction": reconstruction,
    "novel_views": novel_views,
    "fixed_views": fixed_views,
    "pairs": pairs,
    "evaluation": evaluation,
    "effects": effects,
    "rollout_scores": rollout_scores,
}


def make(kind: str, seed: int = 0) -> Any:
    """The value of a kind that a seed gives."""
    return MAKERS[kind](np.random.default_rng(seed))


def assert_same(a: Any, b: Any, at: str = "value", approximate: tuple[str, ...] = ()) -> None:
    """Equal in type, dtype, shape and every bit; fields named in ``approximate`` to the colour border's bound."""
    assert type(a) is type(b), at
    if dataclasses.is_dataclass(a):
        for f in dataclasses.fields(a):
            x, y = getattr(a, f.name), getattr(b, f.name)
            if f.name in approximate:
                assert x.dtype == y.dtype and x.shape == y.shape, f"{at}.{f.name}"
                assert x.numel() == 0 or (x - y).abs().max() <= 1e-3, f"{at}.{f.name}"
            else:
                assert_same(x, y, f"{at}.{f.name}", approximate)
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype and torch.equal(a, b), at
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes(), at
    elif isinstance(a, dict):
        assert sorted(a) == sorted(b), at
        for k in a:
            assert_same(a[k], b[k], f"{at}[{k}]", approximate)
    elif isinstance(a, tuple):
        assert len(a) == len(b), at
        for k, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{at}[{k}]", approximate)
    else:
        assert a == b, at


COLORS = ("color", "lidar_color")
