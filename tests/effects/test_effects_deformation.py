"""Actors that deform: the field, its gradients, its place in an optimisation, and that a rigid scene has none of it."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from genre_tasks.config import GnetConfig, InitialConfig, LearningRates, LossConfig, OptimiserConfig
from genre_tasks.effects.nonrigid_actors import (
    DEFORMABLE_WORDS,
    add_rest_deformation,
    is_deformable,
    mask_deformable_actors,
)
from genre_tasks.errors import ArtifactCorruptError, NonFiniteError
from genre_tasks.optimiser.autograd_render import AutogradRender
from genre_tasks.optimiser.auxiliary import AuxiliaryParameters
from genre_tasks.optimiser.deformation_optimiser import DeformationGroup
from genre_tasks.optimiser.gradients import Gradients
from genre_tasks.optimiser.kernel_render import KernelRender
from genre_tasks.optimiser.objective import Objective
from genre_tasks.optimiser.state import Parameterization
from genre_tasks.optimiser.tuned_adam import TunedAdam
from genre_tasks.optimiser.unroll import UnrollSettings, unroll
from genre_tasks.render import RenderSettings, render_views
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.deformation import LATTICE, NODES, Deformation, trilinear_weights
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages.gnet import gnet
from genre_tasks.stages.initial import initial
from genre_tasks.stages.optimise import optimise
from storage.codecs import reconstruction as codec
from storage.codecs.deformation import DEFORMATION
from storage.codecs.tables import write_table
from tests.effects.test_apply_plan import DEFAULT_EFFECTS, chunk, with_
from tests.optimiser import street_scenes

SIZE_M = (1.0, 1.0, 1.0)
SMALL_START = InitialConfig(max_points=2000, distant_count=200)
SMALL_FIT = GnetConfig(iterations=3, views_per_iteration=2, method="adam", loss=LossConfig(perceptual=0))

STILL = LearningRates.from_sequence((0.0,) * 5)


def paths(*frames: tuple[int, ...]) -> tuple[ActorNode, ...]:
    def poses(count: int) -> np.ndarray:
        return np.broadcast_to(np.eye(4), (count, 4, 4)).copy()

    return tuple(ActorNode(f"p{k}", "Pedestrian", SIZE_M, np.array(f), poses(len(f))) for k, f in enumerate(frames))


def some(of: Deformation, scale_m: float = 0.1, seed: int = 0) -> Deformation:
    g = torch.Generator().manual_seed(seed)
    return of.with_offsets(scale_m * torch.randn(of.offsets.shape, generator=g, dtype=of.offsets.dtype))


def walking(scale_m: float = 0.1) -> SceneGraph:
    """The tiny scene, whose only actor deforms at both of its frames."""
    scene = street_scenes.scene()
    return replace(scene, deformation=some(Deformation.zero(scene.actors, (0,), (0, 1)), scale_m))


def test_weights_sum_to_one_and_are_one_at_their_own_point() -> None:
    steps = [torch.linspace(-0.5, 0.5, n, dtype=torch.float64) for n in LATTICE]
    points = torch.stack(torch.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    ones = torch.ones_like(points)
    torch.testing.assert_close(trilinear_weights(points, ones), torch.eye(NODES, dtype=torch.float64))
    anywhere = 3 * torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 1.5
    torch.testing.assert_close(
        trilinear_weights(anywhere, torch.ones_like(anywhere)).sum(1), torch.ones(50, dtype=torch.float64)
    )


def test_offsets_that_are_linear_in_place_shift_linearly() -> None:
    steps = [torch.linspace(-0.5, 0.5, n) for n in LATTICE]
    points = torch.stack(torch.meshgrid(*steps, indexing="ij"), -1).reshape(-1, 3)
    matrix = torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    of = Deformation.zero(paths((0,)), (0,), (0,)).with_offsets((points @ matrix)[None, None])
    at = torch.rand(40, 3, generator=torch.Generator().manual_seed(2)) - 0.5
    torch.testing.assert_close(of.displacements(at, torch.zeros(40, dtype=torch.int64), (0,))[0], at @ matrix)


def test_an_actors_other_frames_are_between_its_own_and_beyond_them_the_nearest() -> None:
    """Frame 4 is not the second actor's own; a third one is known at a single frame, a fourth at none."""
    of = some(Deformation.zero(paths((2, 4, 8), (2, 8), (4,), (11,)), (0, 1, 2, 3), (2, 4, 8)))
    assert of.known.tolist() == [[True] * 3, [True, False, True], [False, True, False], [False] * 3]
    o, at = of.offsets, of.offsets_at((0, 3, 4, 5, 30))
    torch.testing.assert_close(
        at[:, 0], torch.stack([o[0, 0], (o[0, 0] + o[0, 1]) / 2, o[0, 1], 0.75 * o[0, 1] + 0.25 * o[0, 2], o[0, 2]])
    )
    torch.testing.assert_close(at[2, 1], o[1, 0] * 2 / 3 + o[1, 2] / 3)
    torch.testing.assert_close(at[:, 2], o[2, 1].expand(5, -1, -1))
    torch.testing.assert_close(DeformationGroup(of).deformation.offsets_at((2, 4)), of.offsets_at((2, 4)))


def test_a_scene_moves_with_its_deformation_in_its_boxes_axes() -> None:
    scene = walking()
    moved, rigid = scene.gaussians_at(0), replace(scene, deformation=None).gaussians_at(0)
    own = scene.nodes == FIRST_ACTOR
    assert torch.equal(moved.means[~own], rigid.means[~own]) and torch.equal(moved.quats, rigid.quats)
    shifts = scene.deformation.displacements(
        scene.gaussians.means[own], torch.zeros(int(own.sum()), dtype=torch.int64), (0,)
    )
    torch.testing.assert_close(moved.means[own] - rigid.means[own], shifts[0])  # its box is not turned
    assert float(shifts.abs().mean()) > 0.02
    several, moving = scene.gaussians_at_frames((0, 1))
    one = scene.gaussians_at_frames((1,))[0]
    assert torch.equal(several.means[-len(moving) :], one.means[-len(moving) :])


def test_gradients_are_those_of_finite_differences() -> None:
    g = torch.Generator().manual_seed(3)
    of = Deformation.zero(paths((0, 2), (0,)), (0, 1), (0, 2))
    at = (torch.rand(7, 3, generator=g, dtype=torch.float64) - 0.5).requires_grad_()
    offsets = torch.randn(of.offsets.shape, generator=g, dtype=torch.float64, requires_grad=True)
    which = torch.tensor([0, 1, 0, 0, 1, 1, 0])

    def shifts(place: Tensor, nodes: Tensor) -> Tensor:
        return of.with_offsets(nodes).displacements(place, which, (0, 1, 5))

    assert torch.autograd.gradcheck(shifts, (at, offsets))


def test_a_scenes_loss_has_the_offsets_gradient_of_finite_differences() -> None:
    """Through poses, the renderer's reference and its image, in float64."""
    scene = walking(0.05)
    parts = [getattr(scene.gaussians, n).double() for n in Gaussians.__dataclass_fields__]
    scene = replace(scene, gaussians=Gaussians(*parts))
    views, settings = street_scenes.targets(street_scenes.scene())[:2], RenderSettings(backend="reference")
    way = torch.randn(scene.deformation.offsets.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    start = scene.deformation.offsets.double()

    def loss(offsets: Tensor) -> Tensor:
        shown = replace(scene, deformation=scene.deformation.with_offsets(offsets))
        return (render_views(shown, views, settings).color * weight).sum()

    weight = torch.randn(2, 32, 48, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    leaf = start.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(leaf), leaf)
    step = 1e-7  # few of the renderer's cut-offs lie in between
    with torch.no_grad():
        true = float(loss(start + step * way) - loss(start - step * way)) / (2 * step)
    assert float((found * way).sum()) == pytest.approx(true, rel=1e-3)


def test_the_compiled_pass_agrees_with_torch() -> None:
    scene = walking()
    frame, views = Parameterization.from_scene(scene), street_scenes.targets(scene)
    offsets = 0.05 * torch.randn(len(scene), 14, generator=torch.Generator().manual_seed(6))
    found = []
    for kind in (AutogradRender, KernelRender):
        image = kind(frame, offsets, views, RenderSettings(), AuxiliaryParameters(scene.deformation))
        by = torch.rand(image.color.shape, generator=torch.Generator().manual_seed(7))
        gradient = image.gradient(by, 0.01 * torch.ones_like(image.depth))
        found.append((image.color, gradient.gaussians, gradient.deformation))
        assert gradient.deformation is not None and gradient.deformation.abs().max() > 0.1
    for one, two in zip(*found, strict=True):
        assert float((one - two).abs().max()) < 1e-4 * float(one.abs().max())


def test_offsets_are_recovered_with_the_scene_left_as_it_is() -> None:
    truth = walking(0.15)
    source = street_scenes.targets(truth)
    still = TunedAdam(STILL)
    start = replace(truth, deformation=Deformation.zero(truth.actors, (0,), (0, 1)))
    objective = Objective(LossConfig(perceptual=0))
    out = unroll(still, start, source, (), objective, UnrollSettings(60, 4, snapshots=1))
    assert out.losses[-1] < 0.7 * out.losses[0]
    assert torch.equal(out.scene.gaussians.pack(), start.gaussians.pack())
    assert out.snapshots[30].deformation is not None and out.scene.deformation is not None
    again = unroll(still, start, source, (), objective, UnrollSettings(60, 4, snapshots=1))
    assert torch.equal(out.scene.deformation.offsets, again.scene.deformation.offsets)


def test_an_actor_outside_of_the_views_keeps_its_shape() -> None:
    scene = street_scenes.scene()
    away = replace(scene.actors[0], track_id="b", frames=np.array([40, 41]))
    scene = replace(scene, actors=(*scene.actors, away))
    start = replace(scene, deformation=Deformation.zero(scene.actors, (0, 1), (0, 1, 40)))
    rule = TunedAdam(STILL)
    out = unroll(
        rule, start, street_scenes.targets(walking()), (), Objective(LossConfig(perceptual=0)), UnrollSettings(3, 2)
    )
    offsets = out.scene.deformation.offsets
    assert not offsets[1].any() and not offsets[0, 2].any() and offsets[0, :2].any()


def test_a_gradient_that_is_not_finite_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = KernelRender.gradient

    def broken(self: KernelRender, *by_images: Tensor) -> Gradients:
        gradients = real(self, *by_images)
        gradients.deformation[0, 1, 2, 0] = torch.nan
        return gradients

    monkeypatch.setattr(KernelRender, "gradient", broken)
    scene = walking()
    with pytest.raises(NonFiniteError, match="gradient of the deformation"):
        unroll(
            TunedAdam(),
            scene,
            street_scenes.targets(scene),
            (),
            Objective(LossConfig(perceptual=0)),
            UnrollSettings(1, 1),
        )


@pytest.mark.parametrize("word", DEFORMABLE_WORDS)
def test_labels_of_people_deform(word: str) -> None:
    assert is_deformable(word) and is_deformable(f"A {word.upper()}ist")


def test_the_guide_has_the_words_of_people() -> None:
    guide = (Path(__file__).resolve().parents[2] / "docs/guides/genre-layout.md").read_text()
    (words,) = re.findall(r"`label` is free text\. With (.*) in it, the object may change its shape\.", guide)
    assert tuple(re.findall(r"`(\w+)`", words)) == DEFORMABLE_WORDS


def test_only_people_deform_and_at_the_frames_that_have_images() -> None:
    assert is_deformable("Pedestrian") and is_deformable("Motorcyclist") and not is_deformable("Car")
    first = initial(SMALL_START, chunk(), with_(*DEFAULT_EFFECTS, "nonrigid_actors")).scene
    labels = [first.actors[k].label for k in first.deformation.actors]
    assert labels == [a.label for a in chunk().actors if a.label == "Pedestrian"] and labels
    assert set(first.deformation.frames) == {v.frame for v in chunk().views_with_role("source")}
    assert not first.deformation.offsets.any()
    cars = replace(chunk(), actors=tuple(replace(a, label="Car") for a in chunk().actors))
    assert add_rest_deformation(replace(first, deformation=None, actors=()), cars).deformation is None
    view = max(chunk().views, key=lambda v: int(mask_deformable_actors(chunk(), v).sum()))
    assert 0 < mask_deformable_actors(chunk(), view).mean() < 0.2 and not mask_deformable_actors(cars, view).any()


def test_gnet_fits_it_and_enet_keeps_it() -> None:
    on = with_(*DEFAULT_EFFECTS, "nonrigid_actors")
    first = initial(SMALL_START, chunk(), on)
    scene = gnet(SMALL_FIT, chunk(), first, on)
    assert scene.scene.deformation is not None and scene.scene.deformation.offsets.any()
    assert np.isfinite(scene.scene.deformation.offsets.numpy()).all()
    own = OptimiserConfig(**SMALL_FIT.model_dump(exclude={"per_scene", "refine"}))
    kept = optimise("enet", own, chunk(), scene.scene, None)
    assert torch.equal(kept.scene.deformation.offsets, scene.scene.deformation.offsets)
    assert not torch.equal(kept.scene.gaussians.pack(), scene.scene.gaussians.pack())


def test_a_scene_without_it_never_loads_the_code() -> None:
    code = (
        "import sys\n"
        "from tests.effects.test_apply_plan import *\n"
        "first = initial(InitialConfig(max_points=2000, distant_count=200), chunk(), with_(*DEFAULT_EFFECTS))\n"
        "config = GnetConfig(iterations=1, method='adam', loss=LossConfig(perceptual=0))\n"
        "scene = gnet(config, chunk(), first, with_(*DEFAULT_EFFECTS))\n"
        "novel_views(NovelViewsConfig(), chunk(), scene, with_(*DEFAULT_EFFECTS))\n"
        "assert scene.scene.actors and scene.scene.deformation is None\n"
        "loaded = [n for n in sys.modules if n.endswith(('.deformation', '.deforming', '.nonrigid_actors'))]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_an_artifact_keeps_it_and_one_without_has_no_file(tmp_path) -> None:
    scene = walking()
    halfway = replace(scene, deformation=some(scene.deformation, 0.2, seed=8))
    codec.write(tmp_path, Reconstruction(scene, (1.0, 0.5), {1: halfway}))
    back = codec.read(tmp_path)
    for one, two in ((scene, back.scene), (halfway, back.snapshots[1])):
        assert torch.equal(one.deformation.offsets, two.deformation.offsets)
        assert torch.equal(one.deformation.sizes_m, two.deformation.sizes_m)
        assert np.array_equal(one.deformation.known, two.deformation.known)
        assert (one.deformation.actors, one.deformation.frames) == (two.deformation.actors, two.deformation.frames)
    rigid = tmp_path / "rigid"
    rigid.mkdir()
    codec.write(rigid, Reconstruction(replace(scene, deformation=None)))
    assert not (rigid / "deformation.parquet").exists() and codec.read(rigid).scene.deformation is None
    (tmp_path / "deformation.parquet").unlink()
    rows = {"actor": [0, 5], "frame": [0, 0], "known": [True, True], "offsets": [[0.0] * 48] * 2}
    write_table(tmp_path / "deformation.parquet", DEFORMATION, rows)
    with pytest.raises(ArtifactCorruptError, match="2 of 1 actors"):
        codec.read(tmp_path)
