"""Clouds of Gaussians for the tests of formats: seeded, of any degree of harmonics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from genre_tasks.exchange.checks import CLOUD_ATTRIBUTES
from genre_tasks.exchange.types import SH_REST_COUNTS, ExchangeNode, ExchangeScene, NodeMotion, SplatCloud


def make_cloud(count: int, sh_degree: int = 0, seed: int = 0, extent_m: float = 50.0) -> SplatCloud:
    """Gaussians as a street has them: colours strictly in [0, 1], quaternions of any length."""
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4)) * random.uniform(0.3, 3.0, (count, 1))
    return SplatCloud(
        means=random.uniform(-extent_m, extent_m, (count, 3)).astype(np.float32),
        log_scales=random.uniform(-6.0, 1.0, (count, 3)).astype(np.float32),
        quats=quats.astype(np.float32),
        logit_opacities=random.uniform(-5.0, 5.0, count).astype(np.float32),
        sh_dc=random.uniform(-1.7, 1.7, (count, 3)).astype(np.float32),
        sh_rest=random.uniform(-0.5, 0.5, (count, SH_REST_COUNTS[sh_degree], 3)).astype(np.float32),
    )


def change_one(cloud: SplatCloud, attribute: str, value: float, row: int = 1) -> SplatCloud:
    """The cloud with one Gaussian's attribute set to ``value`` throughout."""
    values = getattr(cloud, attribute).copy()
    values[row] = value
    return replace(cloud, **{attribute: values})


def same_bits(a: SplatCloud, b: SplatCloud) -> bool:
    """Whether all arrays have the same bits, type and shape."""
    return all(
        getattr(a, name).dtype == getattr(b, name).dtype
        and getattr(a, name).shape == getattr(b, name).shape
        and getattr(a, name).tobytes() == getattr(b, name).tobytes()
        for name in CLOUD_ATTRIBUTES
    )


def is_finite(scene: ExchangeScene) -> bool:
    """Whether all that a scene holds is finite."""
    clouds = [getattr(node.cloud, name) for node in scene.nodes for name in CLOUD_ATTRIBUTES]
    motions = [node.motion.scene_SE3_node for node in scene.nodes if node.motion is not None]
    return all(np.isfinite(values).all() for values in (*clouds, *motions, scene.times_s, scene.world_SE3_scene))


def make_driving_scene(sh_degree: int = 0, moments: int = 5) -> ExchangeScene:
    """A background, a far shell, a car that turns while it drives, and a pedestrian who leaves and comes back."""
    times = 0.1 * np.arange(moments)
    car = np.broadcast_to(np.eye(4), (moments, 4, 4)).copy()
    turn = 0.8 * times
    car[:, 0, 0] = np.cos(turn)
    car[:, 0, 1] = -np.sin(turn)
    car[:, 1, 0] = np.sin(turn)
    car[:, 1, 1] = np.cos(turn)
    car[:, 0, 3] = 10 + 12 * times
    car[:, 2, 3] = 0.75
    walk = np.broadcast_to(np.eye(4), (moments, 4, 4)).copy()
    walk[:, 1, 3] = 3 - 1.4 * times
    present = np.arange(moments) % 3 != 1
    walk[~present] = np.eye(4)
    world = np.eye(4)
    world[:3, 3] = (1024.5, -2048.25, 12.0)
    return ExchangeScene(
        nodes=(
            ExchangeNode("background", make_cloud(40, sh_degree, seed=1)),
            ExchangeNode("distant", make_cloud(9, sh_degree, seed=2, extent_m=200.0)),
            ExchangeNode(
                name="car-1",
                cloud=make_cloud(20, sh_degree, seed=3, extent_m=2.0),
                motion=NodeMotion(car, np.ones(moments, bool)),
                label="Car",
                track_id="track/7",
                size_m=(4.5, 1.8, 1.5),
            ),
            ExchangeNode(
                name="pedestrian-2",
                cloud=make_cloud(7, sh_degree, seed=4, extent_m=0.5),
                motion=NodeMotion(walk, present),
                label="Pedestrian",
                track_id="9",
                size_m=(0.6, 0.6, 1.75),
            ),
        ),
        times_s=times,
        frames=tuple(range(20, 20 + moments)),
        world_SE3_scene=world,
    )
