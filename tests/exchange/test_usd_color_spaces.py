"""Colour spaces of OpenUSD files: those that others state, and the one that is written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom

from genre_tasks.exchange.activations import sh_dc_to_colors
from genre_tasks.exchange.linear_light import LINEAR_LOSS
from genre_tasks.exchange.types import SH_DC, ExchangeScene
from genre_tasks.exchange.usd.format import USDZ
from genre_tasks.srgb import linear_to_srgb
from tests.exchange.splat_clouds import make_driving_scene, same_bits
from tests.exchange.usd_layers import make_layer
from tests.exchange.usd_layers import read_in_this_process as read_in_this_process

LINEAR = "lin_rec709_scene"
SRGB = "srgb_rec709_scene"

HALF_LIGHT = 0.214041
"""Linear light of the middle grey of sRGB, 0.5."""

ONE_GAUSSIAN = f"""#usda 1.0
(
    upAxis = "Z"
    metersPerUnit = 1
)

def ParticleField3DGaussianSplat "splat" (
    prepend apiSchemas = ["ColorSpaceAPI"]
)
{{
    uniform token colorSpace:name = "{LINEAR}"
    point3f[] positions = [(1, 2, 3)]
    float3[] scales = [(0.1, 0.1, 0.1)]
    quatf[] orientations = [(1, 0, 0, 0)]
    float[] opacities = [0.5]
    uniform int radiance:sphericalHarmonicsDegree = 0
    float3[] radiance:sphericalHarmonicsCoefficients = [({", ".join([str((HALF_LIGHT - 0.5) / SH_DC)] * 3)})]
}}
"""


def read_with(path: Path, change: Any, **arrays: object) -> ExchangeScene:
    """Reads a foreign layer after a change of its stage."""
    stage = make_layer(path, **arrays)
    change(stage)
    stage.GetRootLayer().Save()
    return USDZ.read(path)


def state(space: str, path: str = "/World/splat") -> Any:
    """States the colour space of a prim."""

    def change(stage: Any) -> None:
        Usd.ColorSpaceAPI.Apply(stage.GetPrimAtPath(path)).CreateColorSpaceNameAttr(space)

    return change


# --- what is read


def test_linear_colours_are_converted_and_stated(tmp_path: Path) -> None:
    path = tmp_path / "linear.usda"
    path.write_text(ONE_GAUSSIAN)
    scene = USDZ.read(path)
    np.testing.assert_allclose(sh_dc_to_colors(scene.nodes[0].cloud.sh_dc), 0.5, atol=1e-5)
    assert scene.losses == (LINEAR_LOSS,)


def test_the_tint_of_linear_colours_follows_the_slope(tmp_path: Path) -> None:
    constant = (HALF_LIGHT - 0.5) / SH_DC
    harmonics: dict[str, object] = {
        "radiance:sphericalHarmonicsDegree": 1,
        "radiance:sphericalHarmonicsCoefficients": [*[(constant,) * 3, (0.1, 0.1, 0.1), (0, 0, 0), (0, 0, 0)] * 2],
    }
    plain = read_with(tmp_path / "plain.usdc", state(SRGB), **harmonics).nodes[0].cloud
    converted = read_with(tmp_path / "linear.usdc", state(LINEAR), **harmonics).nodes[0].cloud
    slope = (linear_to_srgb(0.2145) - linear_to_srgb(0.2135)) / 0.001
    np.testing.assert_allclose(converted.sh_rest, plain.sh_rest * slope, rtol=1e-3, atol=1e-6)


def test_a_space_holds_for_what_is_below_and_the_nearest_one_counts(tmp_path: Path) -> None:
    def state_both(stage: Any) -> None:
        state(LINEAR, "/World")(stage)
        state(SRGB)(stage)

    def state_of_the_attribute(stage: Any) -> None:
        state(SRGB)(stage)
        field = stage.GetPrimAtPath("/World/splat")
        field.GetAttribute("radiance:sphericalHarmonicsCoefficients").SetColorSpace(LINEAR)

    inherited = read_with(tmp_path / "inherited.usda", state(LINEAR, "/World"))
    assert inherited.losses == (LINEAR_LOSS,)
    assert read_with(tmp_path / "own.usda", state_of_the_attribute).losses == (LINEAR_LOSS,)
    assert read_with(tmp_path / "both.usda", state_both).losses == ()


@pytest.mark.parametrize("space", ["", SRGB, "srgb_rec709_display", "lin_ap1_scene", "\x1b[2Jx" + 500 * "y"])
def test_other_spaces_are_read_as_srgb(tmp_path: Path, space: str) -> None:
    scene = read_with(tmp_path / "scene.usdc", state(space) if space else lambda stage: None)
    np.testing.assert_allclose(scene.nodes[0].cloud.sh_dc, [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]], atol=1e-7)
    is_known = space.startswith("srgb") or not space
    assert len(scene.losses) == (0 if is_known else 1)
    for loss in scene.losses:
        assert "are read as sRGB" in loss and loss.isprintable() and len(loss) < 150


@pytest.mark.parametrize(("space", "is_linear"), [("", True), (LINEAR, True), (SRGB, False)])
def test_display_colours_are_linear_where_nothing_else_is_stated(tmp_path: Path, space: str, is_linear: bool) -> None:
    def change(stage: Any) -> None:
        field = UsdGeom.Gprim(stage.GetPrimAtPath("/World/splat"))
        field.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(HALF_LIGHT)])
        if space:
            state(space)(stage)

    without = {"radiance:sphericalHarmonicsCoefficients": None, "radiance:sphericalHarmonicsDegree": None}
    scene = read_with(tmp_path / "scene.usda", change, **without)
    expected = 0.5 if is_linear else HALF_LIGHT
    np.testing.assert_allclose(sh_dc_to_colors(scene.nodes[0].cloud.sh_dc), expected, atol=1e-5)
    assert scene.losses == ()


def test_a_field_without_colours_is_grey(tmp_path: Path) -> None:
    without = {"radiance:sphericalHarmonicsCoefficients": None, "radiance:sphericalHarmonicsDegree": None}
    assert not read_with(tmp_path / "scene.usda", state(LINEAR), **without).nodes[0].cloud.sh_dc.any()


# --- what is written


def test_the_space_is_written_for_each_field(tmp_path: Path) -> None:
    scene = make_driving_scene(1)
    USDZ.write(tmp_path / "scene.usdz", scene)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    fields = [prim for prim in stage.Traverse() if prim.GetName() == "gaussians"]
    assert len(fields) == len(scene.nodes)
    for field in fields:
        space = Usd.ColorSpaceAPI(field).GetColorSpaceNameAttr().Get()
        assert field.HasAPI(Usd.ColorSpaceAPI) and space == SRGB and Gf.ColorSpace.IsValid(space)
        # Its curve is that of sRGB: grey is converted as OpenUSD does it.
        converted = Gf.ColorSpace(space).Convert(Gf.ColorSpace(LINEAR), Gf.Vec3f(HALF_LIGHT))
        np.testing.assert_allclose(converted.GetRGB(), 0.5, atol=1e-4)
    assert USDZ.read(tmp_path / "scene.usdz").losses == ()


def test_older_exports_of_ours_are_read_as_before(tmp_path: Path) -> None:
    USDZ.write(tmp_path / "scene.usda", make_driving_scene(2))
    found = USDZ.read(tmp_path / "scene.usda")
    stage = Usd.Stage.Open(str(tmp_path / "scene.usda"))
    for prim in stage.Traverse():
        if prim.HasAPI(Usd.ColorSpaceAPI):
            prim.RemoveProperty("colorSpace:name")
            prim.RemoveAPI(Usd.ColorSpaceAPI)
    stage.GetRootLayer().Export(str(tmp_path / "older.usda"))
    assert "colorSpace" not in (tmp_path / "older.usda").read_text()
    older = USDZ.read(tmp_path / "older.usda")
    assert older.losses == ()
    for before, after in zip(found.nodes, older.nodes, strict=True):
        assert same_bits(before.cloud, after.cloud)
