"""OpenUSD packages as they are written, and the process that reads them."""

from __future__ import annotations

import os
import struct
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdValidation, UsdVol

import genre_tasks
from genre_tasks.errors import InputError
from genre_tasks.exchange.cloud_errors import CloudErrors, compare_clouds
from genre_tasks.exchange.types import NodeMotion
from genre_tasks.exchange.usd.format import USDZ
from genre_tasks.exchange.usd.stage_process import run_stage_dump
from tests.exchange.format_suite import FormatSuite
from tests.exchange.splat_clouds import make_driving_scene
from tests.exchange.usd_layers import make_layer
from tests.exchange.usd_layers import read_in_this_process as read_in_this_process
from tests.exchange.usd_layers import real_process as real_process


class TestUsd(FormatSuite):
    name = "usdz"
    tolerances = CloudErrors(0, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A scene with actors, as a package."""
    path = tmp_path / "scene.usdz"
    USDZ.write(path, make_driving_scene(2))
    return path


# --- what is written


def test_validators_of_openusd_find_nothing(package: Path) -> None:
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    stage = Usd.Stage.Open(str(package))
    assert [error.GetMessage() for error in context.Validate(stage)] == []
    # The validators look at such things: without a default prim there is an error.
    broken = Usd.Stage.Open(str(package))
    broken.GetRootLayer().defaultPrim = ""
    assert context.Validate(broken)


def test_the_package_is_aligned_and_not_compressed(package: Path) -> None:
    data = package.read_bytes()
    with zipfile.ZipFile(package) as archive:
        (member,) = archive.infolist()
    assert member.compress_type == zipfile.ZIP_STORED and member.filename == "scene.usdc"
    name_bytes, extra_bytes = struct.unpack("<HH", data[26:30])
    start = 30 + name_bytes + extra_bytes
    assert start % 64 == 0 and data[start : start + 8] == b"PXR-USDC"


def test_openusd_shows_actors_where_they_are(package: Path) -> None:
    scene = make_driving_scene()
    stage = Usd.Stage.Open(str(package))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == 10 and (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, 4)
    car = stage.GetPrimAtPath("/Scene/car_1/gaussians")
    motion = scene.nodes[2].motion
    assert motion is not None
    for moment in (0, 2, 4):
        matrix = np.array(UsdGeom.XformCache(moment).GetLocalToWorldTransform(car)).T
        np.testing.assert_allclose(matrix, motion.scene_SE3_node[moment], atol=1e-9)
    # Halfway it has gone half of the way and has turned half of the angle, without any shear.
    matrix = np.array(UsdGeom.XformCache(0.5).GetLocalToWorldTransform(car)).T
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
    assert np.arctan2(matrix[1, 0], matrix[0, 0]) == pytest.approx(0.8 * 0.05)
    assert matrix[0, 3] == pytest.approx(10 + 12 * 0.05)
    walker = UsdGeom.Imageable(stage.GetPrimAtPath("/Scene/pedestrian_2/gaussians"))
    assert [walker.ComputeVisibility(t) for t in (0, 1, 2)] == ["inherited", "invisible", "inherited"]


def test_attributes_are_those_of_the_schema(package: Path) -> None:
    cloud = make_driving_scene(2).nodes[2].cloud
    stage = Usd.Stage.Open(str(package))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Scene/car_1/gaussians"))
    assert field.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 2
    coefficients = np.array(field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(len(cloud), 9, 3)
    np.testing.assert_array_equal(coefficients[:, 0], cloud.sh_dc)
    np.testing.assert_array_equal(coefficients[:, 1:], cloud.sh_rest)
    np.testing.assert_allclose(field.GetScalesAttr().Get(), np.exp(cloud.log_scales), rtol=1e-6)
    np.testing.assert_allclose(field.GetOpacitiesAttr().Get(), 1 / (1 + np.exp(-cloud.logit_opacities)), atol=1e-6)
    first = field.GetOrientationsAttr().Get()[0]
    unit = cloud.quats[0] / np.linalg.norm(cloud.quats[0])
    np.testing.assert_allclose([first.GetReal(), *first.GetImaginary()], unit, atol=1e-6)
    low, high = np.array(field.GetExtentAttr().Get())
    assert (low < cloud.means.min(0)).all() and (high > cloud.means.max(0)).all()


def test_the_degree_is_written_also_where_it_is_0(tmp_path: Path) -> None:
    path = tmp_path / "plain.usda"
    USDZ.write(path, make_driving_scene(0))
    assert path.read_text().count("sphericalHarmonicsDegree = 0") == 4


@pytest.mark.parametrize("seed", range(5))
def test_moments_at_any_distance_keep_their_poses(tmp_path: Path, seed: int) -> None:
    scene = make_driving_scene(moments=40)
    random = np.random.default_rng(seed)
    times = np.cumsum(random.uniform(0.01, 0.3, 40))
    times -= times[0]
    motions = [node.motion for node in scene.nodes]
    assert motions[3] is not None
    present = random.random(40) < 0.5
    poses = np.where(present[:, None, None], motions[3].scene_SE3_node, np.eye(4))
    walker = replace(scene.nodes[3], motion=NodeMotion(poses, present))
    USDZ.write(tmp_path / "scene.usda", replace(scene, nodes=(*scene.nodes[:3], walker), times_s=times))
    found = USDZ.read(tmp_path / "scene.usda")
    np.testing.assert_array_equal(found.times_s, times)
    for node, before in zip(found.nodes[2:], (motions[2], walker.motion), strict=True):
        assert node.motion is not None and before is not None
        np.testing.assert_array_equal(node.motion.present, before.present)
        np.testing.assert_allclose(node.motion.scene_SE3_node[present], before.scene_SE3_node[present], atol=1e-9)


def test_names_that_are_no_identifiers_are_kept_apart(tmp_path: Path) -> None:
    scene = make_driving_scene()
    nodes = tuple(
        replace(node, name=name) for node, name in zip(scene.nodes, ("a-1", "a.1", "a_1", "1 ä"), strict=True)
    )
    path = tmp_path / "scene.usdc"
    USDZ.write(path, replace(scene, nodes=nodes))
    assert [node.name for node in USDZ.read(path).nodes] == ["a-1", "a.1", "a_1", "1 ä"]


# --- the process that reads


def test_a_package_that_openusd_could_not_open_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = make_driving_scene(1)
    for limit in (100, 5000):
        # Of the arrays alone, and of the layer that was written.
        monkeypatch.setattr("genre_tasks.exchange.usd.format._MOST_LAYER_BYTES", limit)
        with pytest.raises(InputError, match=r"takes less than 1\.9"):
            USDZ.write(tmp_path / "scene.usdz", scene)
    assert not list(tmp_path.iterdir())
    USDZ.write(tmp_path / "scene.usdc", scene)


@pytest.mark.usefixtures("real_process")
def test_the_process_reads_and_passes_errors_on(package: Path, tmp_path: Path) -> None:
    found = USDZ.read(package)
    for before, after in zip(make_driving_scene(2).nodes, found.nodes, strict=True):
        assert (before.name, before.label, before.track_id) == (after.name, after.label, after.track_id)
        assert compare_clouds(before.cloud, after.cloud).opacities < 1e-6
    make_layer(tmp_path / "bad.usda", opacities=[0.5])
    (tmp_path / "other.usda").write_text("#usda 1.0\n(\n    subLayers = [@bad.usda@]\n)\n")
    (tmp_path / "torn.usda").write_text('#usda 1.0\ndef "A" {')
    for name, words in (("bad", "1 opacities for 2"), ("other", "names another one"), ("torn", "OpenUSD cannot read")):
        with pytest.raises(InputError, match=words) as caught:
            USDZ.read(tmp_path / f"{name}.usda")
        assert caught.value.file == str(tmp_path / f"{name}.usda")


@pytest.mark.usefixtures("real_process")
def test_the_process_runs_no_module_of_the_current_folder(
    package: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "downloads"
    folder.mkdir()
    # What the process imports: a module of one file, and a package.
    for name in ("json.py", "resource.py", "numpy/__init__.py", "pxr/__init__.py", "genre_tasks/__init__.py"):
        module = folder / name
        module.parent.mkdir(exist_ok=True)
        module.write_text(f"open({str(tmp_path / 'was-run')!r}, 'w').close()\n")
    monkeypatch.chdir(folder)
    # As in an interactive session: the empty path is the current folder.
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    assert len(USDZ.read(package).nodes) == 4
    assert not (tmp_path / "was-run").exists()


def test_the_process_finds_a_checkout_that_is_not_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = "genre_tasks.exchange.usd.stage_process"
    root = str(Path(genre_tasks.__file__).parents[1])
    environments = []

    def run(*_: object, env: dict[str, str], **__: object) -> subprocess.CompletedProcess[bytes]:
        environments.append(env)
        return subprocess.CompletedProcess([], 1)

    monkeypatch.setattr(f"{module}.subprocess.run", run)
    make_layer(tmp_path / "any.usda")
    # By the empty path, or by that of the checkout, which then keeps its place.
    for paths, expected in (
        (["", "lib", "/other"], [root, str(Path("lib").absolute()), "/other"]),
        (["/other", root], ["/other", root]),
    ):
        with monkeypatch.context() as patch, pytest.raises(InputError, match="OpenUSD cannot read"):
            patch.setattr(sys, "path", paths)
            run_stage_dump(tmp_path / "any.usda", tmp_path, tmp_path / "any.usda")
        assert environments.pop()["PYTHONPATH"].split(os.pathsep) == expected


def test_the_memory_of_the_process_is_limited() -> None:
    module = "genre_tasks.exchange.usd.stage_dump"
    code = f"import numpy as np; from {module} import limit_memory; limit_memory({{}}); np.empty(2**28)"
    # Two gigabytes: more than a small file may take, and less than a large one.
    results = [
        subprocess.run([sys.executable, "-c", code.format(size)], capture_output=True, text=True, check=False)
        for size in (1000, 2**26)
    ]
    assert results[0].returncode == 1 and "MemoryError" in results[0].stderr
    assert results[1].returncode == 0


def test_without_openusd_the_error_says_what_to_install() -> None:
    code = """
import sys
from genre_tasks.errors import ConfigError
from genre_tasks.exchange.registry import load_format
sys.modules["pxr"] = None
try:
    load_format("usdz")
except ConfigError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "needs the package pxr" in done.stdout and "pip install 'genre[usd]'" in done.stdout
