"""Evaluation: an oracle that renders the truth scores perfectly, and what is measured where."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from flows.reconstruction.report.viewpoints import describe_viewpoint
from genre_tasks.config import EvaluateConfig, IngestConfig
from genre_tasks.errors import NonFiniteError
from genre_tasks.logs.types import Float64, Lens
from genre_tasks.metrics import scoring
from genre_tasks.metrics.results import Evaluation
from genre_tasks.metrics.scoring import real_image_features
from genre_tasks.render.types import Render
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.gaussians import Gaussians
from genre_tasks.scene.graph import STATIC, SceneGraph
from genre_tasks.scene.novel_poses import place_novel_views
from genre_tasks.scene.novel_views import FixedViews, NovelViews
from genre_tasks.scene.reconstruction import Reconstruction
from genre_tasks.stages import evaluation_renders
from genre_tasks.stages.evaluate import evaluate_fixed, evaluate_scene
from genre_tasks.stages.ingest import ingest
from storage.codecs.evaluation import read, write
from tests.fakes import FakeLog
from tests.metrics.test_fid_lpips import FakeInception, FakeVgg, saved

CONFIG = EvaluateConfig(shifts_m=(1.0, 3.0), bootstrap=20)
LOG = FakeLog(frame_count=8, width_px=48, height_px=32, world_offset_m=(64.0, -32.0, 2.0))


@dataclass(frozen=True)
class FakeTruth:
    """Ray-casts the fake world; the world's offset is taken off again."""

    log: FakeLog

    def image(self, frame: int, world_SE3_camera: Float64, lens: Lens) -> np.ndarray:
        pose = world_SE3_camera.copy()
        pose[:3, 3] -= np.asarray(self.log.world_offset_m)
        return self.log.render(pose, lens, frame)


@pytest.fixture(scope="module")
def chunk() -> Chunk:
    return ingest(IngestConfig(width_px=48, height_px=32), LOG, 0)


@pytest.fixture
def scene() -> SceneGraph:
    count = 50
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * 10 - 5 + torch.tensor([8.0, 0.0, 0.0])
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    gaussians = Gaussians(means, torch.full((count, 3), -0.5), quats, torch.full((count,), 2.0), torch.rand(count, 3))
    return SceneGraph(gaussians, torch.full((count,), STATIC), ())


def oracle(chunk: Chunk, noise: float = 0.0):
    """A renderer that ray-casts the truth at the asked poses, with noise if asked."""
    truth, generator = FakeTruth(LOG), torch.Generator().manual_seed(1)

    def render_views(scene, views, settings) -> Render:
        images = [truth.image(v.frame, chunk.world_SE3_chunk @ v.chunk_SE3_camera, v.lens) for v in views]
        color = torch.from_numpy(np.stack(images).astype(np.float32) / 255)
        color = color + noise * torch.randn(color.shape, generator=generator)
        return Render(color, torch.ones(color.shape[:3]), torch.ones(color.shape[:3]))

    return render_views


def by_name(evaluation: Evaluation) -> dict[str, float]:
    names = [m.name for m in evaluation.metrics]
    assert len(set(names)) == len(names)
    return {m.name: m.value for m in evaluation.metrics}


def test_a_perfect_renderer_scores_perfectly(chunk: Chunk, scene: SceneGraph, monkeypatch) -> None:
    """Poses, frames, sides and the pairing with images and truth are right."""
    monkeypatch.setattr(evaluation_renders, "render_views", oracle(chunk))
    result = evaluate_scene(CONFIG, chunk, "gnet", Reconstruction(scene, (0.5,) * 3), FakeTruth(LOG))
    values = by_name(result)
    for group in ("interpolation", "shift_1m", "shift_3m"):
        assert (
            values[f"{group}/psnr"] > 60 and values[f"{group}/ssim"] > 0.9999 and values[f"{group}/perceptual"] < 1e-4
        )
    assert set(values) == {
        f"{g}/{k}"
        for g, ks in {
            "interpolation": ("psnr", "ssim", "perceptual", "cc_psnr"),
            "shift_0m": ("frechet", "kernel"),
            "shift_1m": ("psnr", "ssim", "perceptual", "frechet", "kernel"),
            "shift_3m": ("psnr", "ssim", "perceptual", "frechet", "kernel"),
        }.items()
        for k in ks
    }
    counts = {m.name: m.n for m in result.metrics}
    assert counts["interpolation/psnr"] == counts["shift_0m/kernel"] == 12  # 6 held-out frames × 2 cameras
    assert counts["shift_3m/psnr"] == counts["shift_3m/kernel"] == 32  # 8 frames × 2 cameras × 2 sides
    assert {(v.shift_m > 0, abs(v.shift_m)) for v in result.views} == {
        (False, 0.0),
        *itertools.product((True, False), (1.0, 3.0)),
    }
    ((iteration, accuracy),) = result.curve
    assert iteration == 3 and accuracy > 60


def test_worse_renders_score_worse(chunk: Chunk, scene: SceneGraph, monkeypatch) -> None:
    results = []
    for noise in (0.02, 0.15):
        monkeypatch.setattr(evaluation_renders, "render_views", oracle(chunk, noise))
        results.append(by_name(evaluate_scene(CONFIG, chunk, "gnet", Reconstruction(scene), FakeTruth(LOG))))
    better, worse = results
    assert better["interpolation/psnr"] == pytest.approx(-20 * np.log10(0.02), abs=1.0)
    for name, value in better.items():
        if name.endswith(("psnr", "ssim")):
            assert value > worse[name]
        else:
            assert value < worse[name], name


def test_without_truth_and_by_the_real_renderer(chunk: Chunk, scene: SceneGraph) -> None:
    calls = []
    config = EvaluateConfig(shifts_m=(3.0,), every=4, bootstrap=10)
    result = evaluate_scene(
        config, chunk, "initial", Reconstruction(scene), None, progress=lambda *a: calls.append(a[:2])
    )
    values = by_name(result)
    assert {n for n in values if n.startswith("shift_3m")} == {"shift_3m/frechet", "shift_3m/kernel"}
    assert 0 < values["interpolation/psnr"] < 40
    assert all(v.shift_m == 0 for v in result.views)
    assert sum(v.psnr for v in result.views) / len(result.views) == pytest.approx(values["interpolation/psnr"])
    kernel = next(m for m in result.metrics if m.name == "shift_3m/kernel")
    assert kernel.n == 8 and kernel.low < kernel.high  # 2 frames × 2 cameras × 2 sides
    assert calls[0][0] == 0 and calls[-1][0] == calls[-1][1]
    assert all(a[0] <= b[0] and a[1] == b[1] for a, b in itertools.pairwise(calls))
    assert result.curve[0][0] == 0


def test_pictures_have_the_same_names_in_every_stage(chunk: Chunk, scene: SceneGraph, monkeypatch) -> None:
    monkeypatch.setattr(evaluation_renders, "render_views", oracle(chunk))
    truth = FakeTruth(LOG)
    pictures = evaluate_scene(CONFIG, chunk, "gnet", Reconstruction(scene), truth).pictures
    names = ["0m_front_03", "3m_left_front_04", "3m_right_front_04"]
    assert sorted(pictures) == sorted([*names, *(f"{n}.truth" for n in names)])
    for name in names:
        np.testing.assert_allclose(pictures[name].astype(int), pictures[f"{name}.truth"].astype(int), atol=1)
    assert (pictures[names[1]] != pictures[names[2]]).any()
    fixed, novel = views_of(chunk)
    assert sorted(evaluate_fixed(CONFIG, chunk, fixed, novel, truth).pictures) == sorted(
        [*names[1:], *(f"{n}.truth" for n in names[1:])]
    )
    assert sorted(evaluate_fixed(CONFIG, chunk, fixed, novel, None).pictures) == names[1:]
    none = EvaluateConfig(shifts_m=(), pictures=0)
    assert evaluate_scene(none, chunk, "gnet", Reconstruction(scene), None).pictures == {}


def test_pictures_show_the_true_recording_vehicle(chunk: Chunk, scene: SceneGraph, monkeypatch) -> None:
    mask = np.zeros((chunk.height_px, chunk.width_px), bool)
    mask[-8:] = True
    masked = replace(chunk, views=tuple(replace(view, ego_mask=mask) for view in chunk.views))
    monkeypatch.setattr(evaluation_renders, "render_views", oracle(chunk, noise=0.3))
    pictures = evaluate_scene(CONFIG, masked, "gnet", Reconstruction(scene), FakeTruth(LOG)).pictures
    differs = {name: picture != pictures[f"{name}.truth"] for name, picture in pictures.items() if ".truth" not in name}
    on_path = differs.pop("0m_front_03")
    assert not on_path[mask].any() and on_path[~mask].mean() > 0.9
    # Next to the path no view has a mask.
    assert len(differs) == 2 and all(other[mask].mean() > 0.9 for other in differs.values())


def test_a_camera_of_any_name_has_pictures(chunk: Chunk, scene: SceneGraph, monkeypatch, tmp_path: Path) -> None:
    names = {name: f"{name} (öst), 100 %~=" for name in chunk.camera_names}
    views = tuple(replace(view, camera=names[view.camera]) for view in chunk.views)
    renamed = replace(chunk, camera_names=tuple(names.values()), views=views)
    monkeypatch.setattr(evaluation_renders, "render_views", oracle(renamed))
    config = EvaluateConfig(shifts_m=(), distributions=False)
    evaluation = evaluate_scene(config, renamed, "gnet", Reconstruction(scene), None)
    write(tmp_path, evaluation)
    labels = [describe_viewpoint(name) for name in read(tmp_path).pictures]
    assert len(labels) == len(evaluation.pictures) > 0
    assert f"3 m to the left · {names['front']} · frame 4" in labels


def test_curve_follows_the_snapshots(chunk: Chunk, scene: SceneGraph) -> None:
    grey = scene.with_gaussians(replace(scene.gaussians, logit_opacities=torch.full((len(scene),), -30.0)))
    reconstruction = Reconstruction(scene, (1.0,) * 4, {0: grey, 2: scene})
    config = EvaluateConfig(shifts_m=(), distributions=False, pictures=0)
    result = evaluate_scene(config, chunk, "gnet", reconstruction, None)
    assert [i for i, _ in result.curve] == [0, 2, 4]
    assert result.curve[1][1] == result.curve[2][1] != result.curve[0][1]
    assert {m.name for m in result.metrics} == {f"interpolation/{k}" for k in ("psnr", "ssim", "perceptual", "cc_psnr")}


def views_of(chunk: Chunk, better: float = 0.02, worse: float = 0.1) -> tuple[FixedViews, NovelViews]:
    """Noisy truth as the fixer's images, noisier truth as the renders it was given."""
    views = place_novel_views(chunk, (3.0, -3.0))
    fine, coarse = (oracle(chunk, noise)(None, views, None) for noise in (better, worse))
    blank = torch.zeros_like(fine.alpha)
    novel = NovelViews(views, coarse.color, coarse.alpha, coarse.depth, fine.color, blank, blank)
    return FixedViews(views, fine.color), novel


def test_fixed_views_are_compared_with_their_renders(chunk: Chunk) -> None:
    fixed, novel = views_of(chunk)
    result = evaluate_fixed(CONFIG, chunk, fixed, novel, FakeTruth(LOG))
    values = by_name(result)
    assert result.stage == "fnet"
    assert values["shift_3m/psnr"] == pytest.approx(-20 * np.log10(0.02), abs=1.0)
    assert values["shift_3m/psnr"] > values["shift_3m/render_psnr"] + 8
    for name in ("perceptual", "frechet", "kernel"):
        assert values[f"shift_3m/{name}"] < values[f"shift_3m/render_{name}"]
    assert {m.n for m in result.metrics} == {8} and len(result.views) == 8
    assert {m.name for m in evaluate_fixed(CONFIG, chunk, fixed, novel, None).metrics} == {
        f"shift_3m/{p}{k}" for p in ("", "render_") for k in ("frechet", "kernel")
    }
    with pytest.raises(ValueError, match="those of other views"):
        evaluate_fixed(CONFIG, chunk, FixedViews(fixed.views[::-1], fixed.color), novel, None)


def test_a_render_that_is_not_finite_is_named(chunk: Chunk) -> None:
    fixed, novel = views_of(chunk)
    fixed.color[3, 5, 6, 1] = torch.nan
    with pytest.raises(NonFiniteError) as caught:
        evaluate_fixed(CONFIG, chunk, fixed, novel, None)
    assert (caught.value.camera, caught.value.frame) == (fixed.views[3].camera, fixed.views[3].frame)
    assert caught.value.first_index == (5, 6, 1)


def test_real_features_are_taken_once(chunk: Chunk, monkeypatch) -> None:
    first = real_image_features(chunk)
    assert first.features.shape == (16, 1280) and first.frames == tuple(v.frame for v in chunk.views)
    monkeypatch.setattr(scoring, "decode_image", None)
    assert real_image_features(chunk) is first
    with pytest.raises(TypeError):
        real_image_features(replace(chunk, views=chunk.views[1:]))


def test_truth_is_cast_once_for_all_stages(chunk: Chunk, monkeypatch) -> None:
    fixed, novel = views_of(chunk)
    asked = []

    class Counting(FakeTruth):
        def image(self, frame: int, world_SE3_camera: Float64, lens: Lens) -> np.ndarray:
            asked.append(frame)
            return super().image(frame, world_SE3_camera, lens)

    truth = Counting(LOG)
    first = evaluate_fixed(CONFIG, chunk, fixed, novel, truth)
    assert len(asked) == len(fixed.views)  # the pictures' viewpoints are among them
    assert evaluate_fixed(CONFIG, chunk, fixed, novel, truth).metrics == first.metrics
    assert len(asked) == len(fixed.views)
    evaluate_fixed(CONFIG, chunk, fixed, novel, Counting(LOG))  # another truth is asked anew
    assert len(asked) == 2 * len(fixed.views)
    monkeypatch.setattr(scoring, "_CACHED_TRUTH_BYTES", 1)
    evaluate_fixed(CONFIG, chunk, fixed, novel, Counting(LOG))
    assert len(scoring._truth_images) == 1


def test_same_bytes_at_any_thread_count(chunk: Chunk, scene: SceneGraph) -> None:
    before, results = torch.get_num_threads(), []
    config = EvaluateConfig(shifts_m=(3.0,), every=4, bootstrap=10, pictures=0)
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            scoring._real_features.clear()
            results.append(evaluate_scene(config, chunk, "gnet", Reconstruction(scene), FakeTruth(LOG)))
    finally:
        torch.set_num_threads(before)
    assert results[0] == results[1]


def test_fid_and_lpips_are_there_once_their_networks_are_given(
    chunk: Chunk, scene: SceneGraph, tmp_path: Path, monkeypatch
) -> None:
    files = {
        "inception": saved(FakeInception(), tmp_path / "i.pt"),
        "lpips": saved(FakeVgg(), tmp_path / "v.pt"),
    }
    config = CONFIG.model_copy(update=files)
    found = []
    for noise in (0.02, 0.3):
        monkeypatch.setattr(evaluation_renders, "render_views", oracle(chunk, noise))
        found.append(by_name(evaluate_scene(config, chunk, "gnet", Reconstruction(scene), FakeTruth(LOG))))
    better, worse = found
    assert {n for n in better if n.endswith(("fid", "lpips"))} == {
        "interpolation/lpips",
        "shift_0m/fid",
        "shift_1m/fid",
        "shift_1m/lpips",
        "shift_3m/fid",
        "shift_3m/lpips",
    }
    assert 0 < better["interpolation/lpips"] < worse["interpolation/lpips"]
    assert better["shift_0m/fid"] < worse["shift_0m/fid"]
    fixed, novel = views_of(chunk)
    values = by_name(evaluate_fixed(config, chunk, fixed, novel, FakeTruth(LOG)))
    assert values["shift_3m/lpips"] < values["shift_3m/render_lpips"]
    assert "shift_3m/fid" in values and "shift_3m/render_fid" in values
    bare = by_name(evaluate_fixed(CONFIG, chunk, fixed, novel, FakeTruth(LOG)))
    assert bare == {k: v for k, v in values.items() if not k.endswith(("fid", "lpips"))}


def test_exposure_that_no_scene_can_know_costs_psnr_and_no_cc_psnr(
    chunk: Chunk, scene: SceneGraph, monkeypatch
) -> None:
    def render_darker(scene, views, settings) -> Render:
        render = oracle(chunk)(scene, views, settings)
        return Render(render.color * 0.7, render.alpha, render.depth)

    monkeypatch.setattr(evaluation_renders, "render_views", render_darker)
    result = evaluate_scene(CONFIG, chunk, "gnet", Reconstruction(scene), FakeTruth(LOG))
    values = by_name(result)
    assert values["interpolation/psnr"] < 20 < 50 < values["interpolation/cc_psnr"]
    assert {m.name: m.n for m in result.metrics}["interpolation/cc_psnr"] == 12  # 6 held-out frames × 2 cameras


def test_lpips_has_the_name_of_its_network(chunk: Chunk, scene: SceneGraph, monkeypatch) -> None:
    found = []
    for network, noise in (("alex", 0.02), ("alex", 0.3), ("vgg", 0.02)):
        monkeypatch.setattr(evaluation_renders, "render_views", oracle(chunk, noise))
        config = CONFIG.model_copy(update={"lpips": network, "shifts_m": (1.0,), "every": 4})
        found.append(by_name(evaluate_scene(config, chunk, "gnet", Reconstruction(scene), FakeTruth(LOG))))
    better, worse, vgg = found
    assert {n for n in better if "lpips" in n} == {"interpolation/lpips_alex", "shift_1m/lpips_alex"}
    assert {n for n in vgg if "lpips" in n} == {"interpolation/lpips_vgg", "shift_1m/lpips_vgg"}
    assert 0 < better["interpolation/lpips_alex"] < worse["interpolation/lpips_alex"] < 2
    assert better["shift_1m/lpips_alex"] < worse["shift_1m/lpips_alex"]
