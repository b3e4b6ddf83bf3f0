"""Building and loading the kernel: every failure has one clear line, and constants exist once."""

from __future__ import annotations

import importlib.util
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from genre_tasks.code_closure import include_closure
from genre_tasks.compiled import build, loader
from genre_tasks.compiled.build import Kernel
from genre_tasks.errors import ConfigError, ResourceError
from genre_tasks.logs.types import RollingShutter
from genre_tasks.losses import build_image_loss
from genre_tasks.optimiser.kernels import build_network, build_posing
from genre_tasks.render import RenderSettings, constants, cpu, cuda, render
from genre_tasks.render.kernel import library
from genre_tasks.render.kernel.build import KERNEL
from genre_tasks.render.types import Shutter, VisibleRanges


@pytest.fixture
def fresh_loader():
    library.load_kernel.cache_clear()
    yield library.load_kernel
    library.load_kernel.cache_clear()


def test_missing_library_says_what_to_run(tmp_path, fresh_loader):
    with pytest.raises(ResourceError, match=r"not compiled.*pip install -e \.") as caught:
        fresh_loader(tmp_path)
    assert str(tmp_path) in str(caught.value.file)


def test_stale_library_is_refused(tmp_path, fresh_loader, monkeypatch):
    for isa in loader.supported_instruction_sets():
        shutil.copy(KERNEL.folder / KERNEL.library_name(isa), tmp_path)
    assert fresh_loader(tmp_path)
    fresh_loader.cache_clear()
    monkeypatch.setattr(Kernel, "source_digest", lambda self: "0" * 16)
    with pytest.raises(ResourceError, match="older than its sources"):
        fresh_loader(tmp_path)


def test_broken_library_is_refused(tmp_path, fresh_loader):
    (tmp_path / KERNEL.library_name(loader.supported_instruction_sets()[0])).write_bytes(b"not a library")
    with pytest.raises(ResourceError, match="does not load"):
        fresh_loader(tmp_path)


def test_an_instruction_set_that_is_lacking_is_never_loaded(fresh_loader, monkeypatch):
    monkeypatch.setenv("GENRE_RENDER_ISA", "avx10")
    with pytest.raises(ConfigError, match="GENRE_RENDER_ISA=avx10"):
        fresh_loader()
    monkeypatch.delenv("GENRE_RENDER_ISA")
    monkeypatch.setattr(loader, "_cpu_flags", lambda: {"sse4_2", "popcnt", "ssse3"})
    if "generic" not in build.instruction_sets():
        assert loader.candidate_instruction_sets() == ["sse42"]


def test_a_machine_that_hides_its_flags_is_not_taken_for_an_old_one(monkeypatch):
    known = loader.supported_instruction_sets()
    monkeypatch.setattr(loader, "_cpu_flags", set)
    assert loader.candidate_instruction_sets()[-1] == known[-1]


@pytest.mark.parametrize("beyond", [False, True], ids=["pinhole", "lens and shutter"])
@pytest.mark.parametrize("isa", loader.supported_instruction_sets())
def test_every_instruction_set_draws_the_same_picture(isa, beyond, scene, gradients, fresh_loader, monkeypatch):
    splats, cameras = scene(300)
    if beyond:
        shutter = Shutter.from_rolling_shutters(
            [RollingShutter(0.03, velocity_m_s=(9.0, -0.5, 14.0), turn_rad_s=(0.2, -0.5, 0.3))]
        )
        cameras = replace(cameras, distortion=torch.tensor([[-0.3, 0.12, 0.002, -0.0015, -0.01]]), shutter=shutter)
    truth, exact = gradients(splats, cameras, RenderSettings("reference"), torch.float64)
    monkeypatch.setenv("GENRE_RENDER_ISA", isa)
    monkeypatch.setattr(cpu, "load_kernel", fresh_loader)
    image, grads = gradients(splats, cameras, RenderSettings("cpu", 1))
    assert (image.color.double() - truth.color).abs().max() < 1e-5
    for name, grad in grads.items():
        relative = torch.linalg.vector_norm(grad.double() - exact[name]) / torch.linalg.vector_norm(exact[name])
        assert relative < 1e-5, (name, float(relative))


def test_no_compiler_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(RuntimeError, match=r"install g\+\+ or clang\+\+.*ziglang") as caught:
        build.build([(KERNEL, tmp_path)])
    assert "\n" not in str(caught.value)


def test_a_failing_compiler_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "false")
    with pytest.raises(RuntimeError, match="false failed on the renderer"):
        build.build([(KERNEL, tmp_path)])
    assert not list(tmp_path.iterdir())


def test_a_compiler_that_is_not_there_is_one_clear_line(tmp_path, monkeypatch):
    monkeypatch.setenv("CXX", "clang++-99")
    with pytest.raises(RuntimeError, match=r"the C\+\+ compiler clang\+\+-99 does not start"):
        build.build([(KERNEL, tmp_path)], isas=["sse42", "generic"])
    assert not list(tmp_path.iterdir())


def test_a_build_removes_what_its_compiler_does_not_make(tmp_path, monkeypatch):
    made = dict(list(build.instruction_sets().items())[-1:])
    for isa in build.instruction_sets():
        (tmp_path / KERNEL.library_name(isa)).write_bytes(b"of another compiler")
    monkeypatch.setattr(build, "instruction_sets_for", lambda compiler: made)
    monkeypatch.setattr(build, "_compile", lambda compiler, job: job.folder / job.kernel.library_name(job.isa))
    build.build([(KERNEL, tmp_path)])
    assert [path.name for path in tmp_path.iterdir()] == [KERNEL.library_name(isa) for isa in made]


@pytest.mark.slow
def test_a_fresh_build_loads(tmp_path, fresh_loader):
    paths = build.build([(KERNEL, tmp_path)])
    assert [p.name for p in paths] == [
        KERNEL.library_name(i) for i in build.instruction_sets_for(build.find_compiler())
    ]
    assert fresh_loader(tmp_path).genre_digest().decode() == KERNEL.source_digest()


def test_constants_live_in_one_place():
    text = "".join((KERNEL.folder / s).read_text() for s in KERNEL.sources if Path(s).suffix in (".cpp", ".h"))
    numeric = {n for n in vars(constants) if n.isupper() and isinstance(getattr(constants, n), float)}
    assert numeric == set(KERNEL.constants)
    assert all(re.search(rf"\b{name}\b", text) for name in numeric)
    for literal in (r"0?\.99f", r"0?\.999f", r"1\.?f? */ *255", r"0\.01f", r"(?<![\d.])0?\.3f", r"1e-4f \?"):
        assert not re.search(literal, text), literal


def test_cuda_without_gsplat_says_how_to_get_it(scene):
    if importlib.util.find_spec("gsplat"):
        pytest.skip("gsplat is installed")
    with pytest.raises(ResourceError, match=r"needs gsplat.*\[cuda\]"):
        render(*scene(5), RenderSettings("cuda"))


@pytest.mark.parametrize(("gaussians", "views"), [(0, 2), (5, 0), (0, 0)])
def test_cuda_is_not_asked_for_nothing(scene, monkeypatch, gaussians, views):
    monkeypatch.setattr(cuda, "render_cuda", lambda *_: pytest.fail("asked"))
    splats, cameras = scene(gaussians, 16, 12, views)
    # What is not finite gives no gradient that is not finite.
    splats.means[:1] = torch.nan
    leaves = [getattr(splats, name).requires_grad_() for name in ("means", "scales", "quats", "opacities", "colors")]
    leaves.append(cameras.camera_SE3_chunk.requires_grad_())
    out = render(splats, cameras, RenderSettings("cuda"))
    assert [tuple(x.shape) for x in (out.color, out.alpha, out.depth)] == [(views, 12, 16, 3), *[(views, 12, 16)] * 2]
    assert not out.color.any() and not out.alpha.any() and not out.depth.any() and not out.culled
    (out.color.sum() + out.alpha.sum() + out.depth.sum()).backward()
    assert all(x.grad is not None and not x.grad.any() for x in leaves)


def test_cuda_is_asked_for_views_that_show_something_alone(scene, monkeypatch):
    def draw(splats, cameras):
        size = (len(cameras), cameras.height_px, cameras.width_px)
        assert len(splats) == 3
        return (torch.ones(*size, 3), torch.ones(size), torch.ones(size)), {}

    monkeypatch.setattr(cuda, "render_cuda", draw)
    visible = VisibleRanges(0, ((0, 3), (3, 3)))
    out = render(*scene(3, 16, 12, 2), RenderSettings("cuda"), visible)
    assert out.alpha.amax((1, 2)).tolist() == [1, 0]


def test_cuda_against_the_reference(scene):
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    splats, cameras = scene(300)
    out = render(splats.to("cuda"), cameras, RenderSettings("cuda"))
    truth = render(splats.to(torch.float64), cameras, RenderSettings("reference"))
    assert (out.color.cpu().double() - truth.color).abs().max() < 0.02  # 0.999 against 0.99, and the alpha cut
    assert (out.depth.cpu().double() - truth.depth).abs().mean() < 0.01


KERNELS = (KERNEL, build_image_loss.KERNEL, build_network.KERNEL, build_posing.KERNEL)


def copied_kernel(folder: Path, changed: dict[str, tuple[str, str]]) -> Kernel:
    shutil.copytree(KERNEL.folder.parent, folder, ignore=shutil.ignore_patterns("*.so", "__pycache__"))
    for name, (old, new) in changed.items():
        text = (folder / "kernel" / name).read_text()
        assert old in text
        (folder / "kernel" / name).write_text(text.replace(old, new, 1))
    return replace(KERNEL, folder=folder / "kernel")


def test_comments_make_no_library_stale(tmp_path: Path) -> None:
    """Report: taikinman/imker#31 (comments and docstrings change a task's hash)."""
    comments = {
        "kernel.cpp": ("\n", "\r\n  // why\n"),
        "build.py": ('"""', '"""More about it: '),
        "../constants.py": ("\n\n", "\n\n# why\n"),
    }
    assert copied_kernel(tmp_path / "a", comments).source_digest() == KERNEL.source_digest()
    code = {"../constants.py": ("\n\nNEAR_M = ", "\n\nNEAR_M = 2 * ")}
    assert copied_kernel(tmp_path / "b", code).source_digest() != KERNEL.source_digest()
    code = {"view.h": ("#include", "int added;\n#include")}
    assert copied_kernel(tmp_path / "c", code).source_digest() != KERNEL.source_digest()


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda kernel: kernel.stem)
def test_every_file_that_a_kernel_includes_makes_its_library_stale(kernel: Kernel) -> None:
    listed = {(kernel.folder / name).resolve() for name in kernel.sources}
    shared = {Path(build.__file__).parent / name for name in build.SHARED_SOURCES}
    assert set(include_closure([kernel.folder / kernel.sources[0]])) <= listed | shared
