"""The same bits: from run to run, at any number of threads, with other views or alone."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.raster.work_count import count_work
from genre_tasks.logs.types import Lens
from genre_tasks.render import Cameras, RenderSettings, render, render_views
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.gaussians import Gaussians, Splats
from genre_tasks.scene.graph import FIRST_ACTOR, STATIC, SceneGraph
from genre_tasks.scene.novel_views import NovelView

IMAGES = ("color", "alpha", "depth")
ONE = RenderSettings("cpu", 1)


def _same(a, b) -> bool:
    (image, grads), (other, expected) = a, b
    images = all(torch.equal(getattr(image, n), getattr(other, n)) for n in IMAGES)
    return images and image.culled == other.culled and all(torch.equal(grads[n], expected[n]) for n in expected)


@pytest.mark.parametrize("views", [1, 3])
@pytest.mark.parametrize(("n", "width", "height"), [(1, 1, 1), (301, 33, 17), (5003, 320, 180)])
def test_same_bits_at_any_thread_count_and_again(scene, gradients, n, width, height, views):
    splats, cameras = scene(n, width, height, views=views)
    first = gradients(splats, cameras, ONE)
    assert n == 1 or first[0].alpha.mean() > 0.1
    assert _same(gradients(splats, cameras, ONE), first)
    for threads in (2, 3, 5):
        assert _same(gradients(splats, cameras, RenderSettings("cpu", threads)), first), threads


def test_same_bits_where_the_sort_takes_several_threads(scene, gradients):
    splats, cameras = scene(300_000)
    first = gradients(splats, cameras, ONE)
    assert count_work(splats, cameras).drawn > 200_000
    for threads in (2, 3):
        assert _same(gradients(splats, cameras, RenderSettings("cpu", threads)), first), threads


def test_many_views_are_the_single_views(scene, gradients):
    splats, cameras = scene(2000, views=5)
    together, grads = gradients(splats, cameras, RenderSettings("cpu", 2))
    parts = {n: getattr(cameras, n) for n in ("camera_SE3_chunk", "focal_px", "center_px")}
    for v in range(5):
        alone = render(splats, replace(cameras, **{n: t[v : v + 1] for n, t in parts.items()}), ONE)
        assert all(torch.equal(getattr(together, n)[v], getattr(alone, n)[0]) for n in IMAGES)
    assert all(torch.isfinite(g).all() for g in grads.values())


def test_a_retained_graph_gives_the_same_gradient_twice(scene):
    splats, cameras = scene(300)
    means = splats.means.clone().requires_grad_()
    loss = render(replace(splats, means=means), cameras, ONE).color.square().sum()
    (first,) = torch.autograd.grad(loss, means, retain_graph=True)
    (second,) = torch.autograd.grad(loss, means)
    assert torch.equal(first, second)


def test_python_threads_may_render_at_the_same_time(scene, gradients):
    jobs = [scene(1000 + 50 * k, views=2, seed=k) for k in range(6)]
    expected = [gradients(*job, ONE) for job in jobs]
    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(lambda job: gradients(*job, RenderSettings("cpu", 2)), jobs))
    assert all(_same(a, b) for a, b in zip(found, expected, strict=True))


def _graph(splats: Splats) -> SceneGraph:
    gaussians = Gaussians(splats.means, splats.scales.log(), splats.quats, torch.logit(splats.opacities), splats.colors)
    path = np.broadcast_to(np.eye(4), (2, 4, 4)).copy()
    path[1, 0, 3] = 3.0
    actor = ActorNode("a", "car", (4.0, 2.0, 1.5), np.array([0, 1]), path)
    nodes = torch.where(torch.arange(len(splats)) % 2 == 0, STATIC, FIRST_ACTOR)
    return SceneGraph(gaussians, nodes, (actor,))


def test_views_of_moving_actors_keep_their_order(scene):
    splats, cameras = scene(300, views=2)
    graph = _graph(splats)
    lens = Lens(45.0, 45.0, 32.0, 24.0, 64, 48)
    poses = [np.linalg.inv(p.double().numpy()) for p in cameras.camera_SE3_chunk]
    views = [NovelView("c", f, 0.0, poses[v], lens, ("c", 0)) for f, v in ((1, 0), (0, 1), (1, 1), (2, 0), (0, 0))]
    out = render_views(graph, views, ONE)
    for i, view in enumerate(views):
        alone = render(
            graph.gaussians_at(view.frame).activate(), Cameras.from_poses([view.chunk_SE3_camera], [lens]), ONE
        )
        assert all(torch.equal(getattr(out, n)[i], getattr(alone, n)[0]) for n in IMAGES)
    assert not torch.equal(out.color[0], out.color[4])
    still = render_views(replace(graph, actors=()), views, ONE)
    assert torch.equal(still.color[0], still.color[4])


def test_views_of_mixed_sizes_are_refused(scene):
    graph = _graph(scene(10)[0])
    lenses = [Lens(45.0, 45.0, 32.0, 24.0, 64, 48), Lens(45.0, 45.0, 32.0, 24.0, 32, 24)]
    views = [NovelView("c", 0, 0.0, np.eye(4), lens, ("c", 0)) for lens in lenses]
    with pytest.raises(ValueError, match="one image size"):
        render_views(graph, views)
