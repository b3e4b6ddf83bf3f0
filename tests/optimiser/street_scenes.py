"""A tiny scene and views of it, rendered by the project's own renderer: no files, no log."""

from __future__ import annotations

import numpy as np
import torch

from genre_tasks.logs.types import Lens
from genre_tasks.losses.ssim import SsimTarget
from genre_tasks.losses.targets import Target
from genre_tasks.render import render_views
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import DISTANT, FIRST_ACTOR, STATIC, SceneGraph

LENS = Lens(40.0, 40.0, 24.0, 16.0, 48, 32)


def scene(count: int = 300, seed: int = 0, actor: bool = True) -> SceneGraph:
    """Gaussians in front of the cameras, a few of them distant and a few an actor's."""
    g = torch.Generator().manual_seed(seed)
    means = torch.rand(count, 3, generator=g) * torch.tensor([8.0, 5.0, 10.0]) + torch.tensor([-4.0, -2.5, 4.0])
    nodes = torch.full((count,), STATIC)
    nodes[: count // 10] = DISTANT
    means[: count // 10] *= 10
    actors: tuple[ActorNode, ...] = ()
    if actor:
        nodes[-count // 10 :] = FIRST_ACTOR
        means[-count // 10 :] = torch.rand(count // 10, 3, generator=g) - 0.5
        poses = np.stack([np.eye(4)] * 2)
        poses[:, :3, 3] = [[0, 0, 6], [1, 0, 6]]
        actors = (ActorNode("a", "Car", (1.0, 1.0, 1.0), np.array([0, 1]), poses),)
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=g), dim=1)
    scales = torch.full((count, 3), -1.3) + 0.2 * torch.randn(count, 3, generator=g)
    scales[: count // 10] += 2.3
    colors = torch.rand(count, 3, generator=g)
    return SceneGraph(Gaussians(means, scales, quats, torch.full((count,), 0.4), colors), nodes, actors)


def pose(x: float) -> np.ndarray:
    """A camera at (x, 0, 0) that looks along z."""
    out = np.eye(4)
    out[0, 3] = x
    return out


def targets(truth: SceneGraph, novel: bool = False) -> tuple[Target, ...]:
    """Two cameras at two frames; with LiDAR depth on half the pixels, or at shifted poses without depth."""
    bare = [
        Target(
            f"c{c}",
            f,
            pose(0.5 * c + 0.2 * f + (1.0 if novel else 0.0)),
            LENS,
            SsimTarget.from_image(torch.zeros(32, 48, 3)),
        )
        for f in (0, 1)
        for c in (0, 1)
    ]
    with torch.no_grad():
        image = render_views(truth, bare)
    out = []
    for i, t in enumerate(bare):
        depth = image.expected_depth()[i].clone()
        depth[::2] = 0
        picture = SsimTarget.from_image(image.color[i].contiguous())
        out.append(Target(t.camera, t.frame, t.chunk_SE3_camera, t.lens, picture, None if novel else depth, novel))
    return tuple(out)


def blurred(truth: SceneGraph, seed: int = 1) -> SceneGraph:
    """The scene with grey, shaken Gaussians: a start to recover the truth from."""
    g, r = truth.gaussians, torch.Generator().manual_seed(seed)
    means = g.means + 0.1 * torch.randn(g.means.shape, generator=r)
    return truth.with_gaussians(Gaussians(means, g.log_scales, g.quats, g.logit_opacities, 0.5 * g.colors + 0.25))
