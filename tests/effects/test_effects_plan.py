"""The plan: gates flip at their thresholds, what is off is not imported, what is impossible is refused."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from flows.configuration import load_configuration
from genre_tasks.config import EffectsConfig, IngestConfig
from genre_tasks.effects.measurements import ChunkMeasurements, PointColors
from genre_tasks.effects.plan import EFFECT_NAMES, load_effect, plan_effects
from genre_tasks.effects.types import EffectsPlan
from genre_tasks.errors import ConfigError
from genre_tasks.logs.registry import open_log
from genre_tasks.logs.types import Camera
from genre_tasks.scene.chunk import Chunk
from genre_tasks.stages.ingest import ingest
from storage.codecs import effects as codec
from tests.effects.imports import assert_imports_no_effect

STREET = "synthetic:street?seed=1020&frames=8&cameras=2&width=160&height=90&samples=1"


@cache
def chunk(uri: str = STREET) -> Chunk:
    return ingest(IngestConfig(width_px=160, height_px=90), open_log(uri), 0)


@cache
def cameras(uri: str = STREET) -> tuple[Camera, ...]:
    return open_log(uri).cameras


def only(*names: str, setting: str = "auto") -> EffectsConfig:
    return EffectsConfig.model_validate({n: setting if n in names else "off" for n in EFFECT_NAMES})


def planned(name: str, of: Chunk | None = None, rig: tuple[Camera, ...] | None = None) -> EffectsPlan:
    return plan_effects(only(name), of or chunk(), rig or cameras())


def test_every_effect_is_asked_and_says_why() -> None:
    found = plan_effects(EffectsConfig(), chunk(), cameras())
    assert tuple(d.name for d in found.decisions) == EFFECT_NAMES
    for d in found.decisions:
        assert d.reason and d.cost and d.property and d.setting == "auto"
        called = d.value > d.threshold  # False for NaN
        assert (d.choice == "off") == (not called)
    on = {d.name for d in found.decisions if d.choice == "on"}
    assert {"rigid_actors", "distant_region", "lidar_depth"} <= on
    assert not on & {"rolling_shutter", "lens_distortion", "motion_blur", "ego_mask", "darkness"}


def test_what_is_off_is_not_measured_nor_imported() -> None:
    code = (
        "from genre_tasks.effects.plan import EFFECT_NAMES, plan_effects\n"
        "from genre_tasks.config import EffectsConfig\n"
        "from tests.effects.test_effects_plan import STREET, chunk, cameras\n"
        "found = plan_effects(EffectsConfig(**dict.fromkeys(EFFECT_NAMES, 'off')), chunk(), cameras())\n"
        "assert all(d.choice == 'off' for d in found.decisions)\n"
    )
    assert_imports_no_effect(code)


def test_set_on_is_on_below_the_threshold_too_and_what_the_log_lacks_is_refused() -> None:
    assert plan_effects(only("exposure", setting="on"), chunk(), cameras())["exposure"].choice == "on"
    with pytest.raises(ConfigError, match=r"is set on, and the log states no readout time.*auto or off"):
        plan_effects(only("rolling_shutter", setting="on"), chunk(), cameras())


@pytest.mark.parametrize(("name", "field"), [("rolling_shutter", "readout_s"), ("motion_blur", "exposure_s")])
def test_shutter_gates_flip_at_their_threshold(name: str, field: str) -> None:
    limit = load_effect(name).threshold
    at_a_second = planned(name, rig=tuple(replace(c, **{field: 1.0}) for c in cameras()))[name].value
    assert at_a_second > limit
    called = "mark" if load_effect(name).report_only else "on"
    for factor, choice in ((0.98, "off"), (1.02, called)):
        rig = tuple(replace(c, **{field: factor * limit / at_a_second}) for c in cameras())
        assert planned(name, rig=rig)[name].choice == choice


def test_the_gate_of_view_dependent_colour_flips_at_its_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    name, limit = "view_dependent_colour", load_effect("view_dependent_colour").threshold
    left, factor = ChunkMeasurements(chunk(), cameras()).color_residuals, 1.0
    monkeypatch.setattr(ChunkMeasurements, "color_residuals", property(lambda self: factor * left))
    plain = planned(name)[name].value
    assert 0 < plain < limit, "a street without gloss does not call for it"
    for part, choice in ((0.98, "off"), (1.02, "on")):
        factor = part * limit / plain
        assert planned(name)[name].choice == choice


def test_a_standing_camera_has_no_shutter_displacement() -> None:
    still = chunk(STREET + "&standstill=1")
    rig = tuple(replace(c, readout_s=0.03) for c in cameras())
    assert planned("rolling_shutter", still, rig)["rolling_shutter"].value == pytest.approx(0, abs=0.05)


def _ahead(metres: float) -> Chunk:
    """The camera of the first source view again a tenth of a second later, so far along its axis."""
    view = chunk().views_with_role("source")[0]
    pose = view.chunk_SE3_camera.copy()
    pose[:3, 3] += metres * pose[:3, 2]
    other = replace(view, frame=view.frame + 1, timestamp_s=view.timestamp_s + 0.1, chunk_SE3_camera=pose)
    return replace(chunk(), views=(view, replace(other, role="heldout")))


def test_driving_straight_ahead_moves_what_is_off_the_axis() -> None:
    rig = tuple(replace(c, readout_s=0.03) for c in cameras())
    one, two = (planned("rolling_shutter", _ahead(way), rig)["rolling_shutter"].value for way in (1.0, 2.0))
    assert one > 0.3 and two == pytest.approx(2 * one, rel=1e-6)
    twice = tuple(replace(c, readout_s=0.06) for c in cameras())
    assert planned("rolling_shutter", _ahead(1.0), twice)["rolling_shutter"].value == pytest.approx(2 * one)


def test_a_drift_along_a_chain_of_images_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty images, each sharing points with the next one alone: the hardest case of taking turns."""
    g = np.random.default_rng(3)
    drift, shared = np.linspace(-0.3, 0.3, 20), 60
    value = np.full((20, 19 * shared, 3), np.nan)
    for k in range(19):
        own = g.normal(-2, 0.5, (shared, 3))
        at = slice(k * shared, (k + 1) * shared)
        for n in (k, k + 1):
            value[n, at] = own + drift[n] + g.normal(0, 0.02, (shared, 3))
    view = chunk().views_with_role("source")[0]
    measurements = ChunkMeasurements(chunk(), cameras())
    monkeypatch.setattr(
        ChunkMeasurements, "point_colors", PointColors((view,) * 20, value, *np.zeros((2, *value.shape[:2])))
    )
    np.testing.assert_allclose(measurements.log_gains, np.repeat(drift[:, None], 3, 1), atol=0.03)
    assert float(np.nanstd(measurements.color_residuals)) < 0.03


def test_images_that_share_nothing_are_not_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    g = np.random.default_rng(4)
    value = np.full((4, 300, 3), np.nan)
    value[:2, :100] = g.normal(-2, 0.5, (100, 3))
    value[1, :100] += 0.4
    value[2, 100:200], value[3, 200:] = -1.0, -3.0
    view = chunk().views_with_role("source")[0]
    monkeypatch.setattr(
        ChunkMeasurements, "point_colors", PointColors((view,) * 4, value, *np.zeros((2, *value.shape[:2])))
    )
    found = planned("exposure")["exposure"]
    assert found.value == pytest.approx(20, abs=0.5) and "of 2 images" in found.reason
    value[1] = np.nan
    assert "no two images share" in planned("exposure")["exposure"].reason


def test_distortion_gate_flips_with_the_coefficient() -> None:
    def bent(k1: float) -> Chunk:
        views = [replace(v, lens=replace(v.lens, distortion=(k1, 0.0, 0.0, 0.0, 0.0))) for v in chunk().views]
        return replace(chunk(), views=tuple(views))

    per_unit = planned("lens_distortion", bent(1.0))["lens_distortion"].value
    for factor, choice in ((0.98, "off"), (1.02, "on")):
        assert (
            planned("lens_distortion", bent(factor * load_effect("lens_distortion").threshold / per_unit))[
                "lens_distortion"
            ].choice
            == choice
        )


def _brightened(image: np.ndarray, gain: float) -> np.ndarray:
    coded = (image / 255.0 + 0.055) * gain ** (1 / 2.4) - 0.055
    return (255 * coded.clip(0, 1)).round().astype(np.uint8)


def test_exposure_reads_the_gains_that_images_were_given(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = ChunkMeasurements(chunk(), cameras()).log_gains
    given = np.random.default_rng(0).normal(0, 0.25, len(plain))
    each = iter(given)
    decoded = ChunkMeasurements.decode_view
    monkeypatch.setattr(
        ChunkMeasurements, "decode_view", lambda self, view: _brightened(decoded(self, view), math.exp(next(each)))
    )
    found = ChunkMeasurements(chunk(), cameras()).log_gains
    np.testing.assert_allclose(found - plain, np.repeat((given - given.mean())[:, None], 3, 1), atol=0.06)


def test_exposure_is_called_for_where_gains_vary_and_not_on_a_plain_street(monkeypatch: pytest.MonkeyPatch) -> None:
    assert planned("exposure")["exposure"].choice == "off"
    decoded, count = ChunkMeasurements.decode_view, [0]

    def alternating(self: ChunkMeasurements, view: object) -> np.ndarray:
        count[0] += 1
        return _brightened(decoded(self, view), 1.2 if count[0] % 2 else 0.8)

    monkeypatch.setattr(ChunkMeasurements, "decode_view", alternating)
    assert planned("exposure")["exposure"].choice == "on"


def test_actors_gate_flips_at_half_a_metre() -> None:
    first = chunk().actors[0]

    def moving(way_m: float) -> Chunk:
        poses = np.repeat(first.chunk_SE3_box[:1], 2, 0).copy()
        poses[1, 0, 3] += way_m
        return replace(chunk(), actors=(replace(first, frames=first.frames[:2], chunk_SE3_box=poses),))

    assert planned("rigid_actors", moving(0.49))["rigid_actors"].choice == "off"
    assert planned("rigid_actors", moving(0.51))["rigid_actors"].choice == "on"
    assert planned("rigid_actors", replace(chunk(), actors=()))["rigid_actors"].value == 0


def test_pedestrians_count_by_their_area() -> None:
    actor, view = chunk().actors[0], chunk().views_with_role("source")[0]
    ahead = view.chunk_SE3_camera @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 10.0], [0, 0, 0, 1]])
    at = np.array([view.frame])

    def sized(side_m: float, label: str) -> Chunk:
        own = replace(actor, label=label, frames=at, chunk_SE3_box=ahead[None], size_m=(side_m, side_m, 0.01))
        return replace(chunk(), actors=(own,), views=(view,))

    area = view.lens.width_px * view.lens.height_px
    per_m2 = view.lens.fx_px * view.lens.fy_px / 100 / area * 100  # percent
    limit = (load_effect("nonrigid_actors").threshold / per_m2) ** 0.5
    with_nodes = only("nonrigid_actors").model_copy(update={"rigid_actors": "on"})
    for factor, label, choice in ((0.97, "Pedestrian", "off"), (1.03, "Pedestrian", "on"), (3, "Car", "off")):
        found = plan_effects(with_nodes, sized(factor * limit, label), cameras())["nonrigid_actors"]
        assert found.choice == choice
    # Without nodes of their own there is nothing that could change its shape.
    crowded = sized(1.03 * limit, "Pedestrian")
    alone = planned("nonrigid_actors", crowded)["nonrigid_actors"]
    assert alone.choice == "off" and alone.value > alone.threshold
    assert alone.reason.startswith("rigid_actors, which it needs, is off; ")
    # What is decided for a chunk ends no run: rigid actors may be on in the next one.
    forced = plan_effects(only("nonrigid_actors", setting="on"), crowded, cameras())["nonrigid_actors"]
    assert forced.choice == "off" and forced.reason.startswith("rigid_actors, which it needs, is off; set on; ")
    # A chunk without any is no error: it has nothing to miss.
    empty = replace(crowded, actors=())
    assert plan_effects(only("nonrigid_actors", setting="on"), empty, cameras())["nonrigid_actors"].choice == "on"


def test_without_lidar_the_depth_term_is_off_and_all_is_distant() -> None:
    points = chunk().static
    none = replace(points, **{n: getattr(points, n)[:0] for n in ("positions", "colors", "colored", "frames")})
    empty = replace(chunk(), static=none, actors=())
    found = plan_effects(
        only("lidar_depth", "distant_region", "exposure", "anti_aliasing", "rolling_shutter"), empty, cameras()
    )
    assert found["lidar_depth"].choice == "off" and found["lidar_depth"].value == 0
    assert found["distant_region"].value == pytest.approx(100)
    assert found["exposure"].choice == "off" and math.isnan(found["exposure"].value)


def test_the_bonnet_is_found_and_a_vehicle_that_stands_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    assert planned("ego_mask")["ego_mask"].choice == "off"
    decoded = ChunkMeasurements.decode_view

    def with_bonnet(rows: int):
        def seen(self: ChunkMeasurements, view: object) -> np.ndarray:
            image = decoded(self, view).copy()
            image[len(image) - rows :, 40:120] = 30
            return image

        return seen

    for rows, choice in ((0, "off"), (2, "on")):  # 80 of 160 pixels of 2 of 90 rows are 1.1 %
        monkeypatch.setattr(ChunkMeasurements, "decode_view", with_bonnet(rows))
        assert planned("ego_mask")["ego_mask"].choice == choice
    still = planned("ego_mask", chunk(STREET + "&standstill=1"))["ego_mask"]
    assert still.choice == "off" and "stands still" in still.reason


def test_paint_that_mirrors_the_world_is_the_vehicles_own_too() -> None:
    """Half of the bonnet changes as the street does; its outline is one arc from side to side."""
    from genre_tasks.effects.ego_mask import find_vehicle

    g = np.random.default_rng(0)
    columns = np.arange(160)
    top = 70 + 8 * ((columns - 80) / 80) ** 2
    covered = np.arange(90)[:, None] >= top
    images = g.uniform(90, 200, (10, 90, 160, 3)).astype(np.float32)
    mirrored = 30 + 20 * g.uniform(0, 1, (10, 1, 160, 1)).astype(np.float32) * (columns > 100)[None, None, :, None]
    images = np.where(covered[None, ..., None], mirrored, images)
    found = find_vehicle(images)
    assert (found & covered).sum() > 0.9 * covered.sum() and (found & ~covered).sum() < 0.02 * covered.sum()
    elsewhere = np.where(covered[None, ..., None], g.uniform(90, 200, images.shape), images)
    assert not find_vehicle(elsewhere.astype(np.float32)).any()


def test_an_outline_that_is_no_arc_is_followed_along_its_edge() -> None:
    """To the right the boot mirrors moving cars, and its outline is level, where the arc of its left goes down."""
    from genre_tasks.effects.ego_mask import find_vehicle

    g = np.random.default_rng(0)
    columns = np.arange(320)
    top = 120 + 14 * np.clip(150 - columns, 0, None) ** 2 / 150**2
    covered = np.arange(180)[:, None] >= top
    images = g.uniform(120, 160, (10, 180, 320, 3)).astype(np.float32)
    mirrored = 30 + 25 * g.uniform(0, 1, (10, 1, 320, 1)).astype(np.float32) * (columns > 200)[None, None, :, None]
    found = find_vehicle(np.where(covered[None, ..., None], mirrored, images))
    assert (found & covered).sum() > 0.97 * covered.sum() and (found & ~covered).sum() < 0.02 * covered.sum()


def test_a_still_road_keeps_its_colours() -> None:
    """Eight small images of a street without a bonnet: half of them stands still, and is road."""
    uri = "synthetic:street?seed=900&frames=8&cameras=1&width=128&height=72&moving=0&pedestrians=0"
    street = ingest(IngestConfig(width_px=128, height_px=72), open_log(uri), 0)
    assert planned("ego_mask", street, open_log(uri).cameras).parameters.ego_points is None


def test_paint_of_the_roads_colour_is_found_by_what_moves_beside_it() -> None:
    """A night's road is as still as the paint, and is not the vehicle."""
    from genre_tasks.effects.ego_mask import find_vehicle

    g = np.random.default_rng(0)
    covered = np.arange(90)[:, None] >= np.full(160, 85)
    road = 60 + 8 * g.normal(size=(10, 90, 160, 1)).astype(np.float32) * np.ones(3, np.float32)
    images = np.where(covered[None, ..., None], np.float32(60), road)
    assert np.array_equal(find_vehicle(images), covered)
    fading = (np.arange(90, dtype=np.float32)[::-1] / 40)[None, :, None, None]
    assert not find_vehicle((5 + fading * (road - 60) / 8).astype(np.float32)).any()


def test_a_night_with_passing_lights_is_no_vehicle() -> None:
    from genre_tasks.effects import ego_mask

    images = np.full((8, 40, 60, 3), 5.0, np.float32)
    for frame in range(8):
        images[frame, 10:20, 5 * frame : 5 * frame + 8] = 200
    poses = np.tile(np.eye(4), (8, 1, 1))
    poses[:, 0, 3] = np.arange(8)
    chunk = SimpleNamespace(camera_names=("front",), chunk_SE3_ego=poses)
    assert ego_mask.find_vehicle(images).all()
    over_time = SimpleNamespace(chunk=chunk, images_over_time={"front": images})
    measured = ego_mask.measure(over_time)  # type: ignore[arg-type]
    assert measured.value == 0
    assert "100 % of front stand still, more than a vehicle fills" in str(measured)
    assert not ego_mask.fit(over_time).ego_masks  # type: ignore[arg-type]


def test_dark_images_are_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    decoded = ChunkMeasurements.decode_view
    monkeypatch.setattr(ChunkMeasurements, "decode_view", lambda self, view: decoded(self, view) // 8)
    assert planned("darkness")["darkness"].choice == "mark"


def test_what_is_only_told_cannot_be_set_on() -> None:
    for name in EFFECT_NAMES:
        if load_effect(name).report_only:
            with pytest.raises(ValueError, match="'auto' or 'off'"):
                only(name, setting="on")
            with pytest.raises(ConfigError, match=f"effects.{name} is not allowed"):
                load_configuration("small", settings=[f"effects.{name}=on"])
    each = load_configuration("small", settings=["effects=on"]).effects
    assert {n: getattr(each, n) for n in EFFECT_NAMES} == {
        n: "auto" if load_effect(n).report_only else "on" for n in EFFECT_NAMES
    }


def test_a_plan_is_the_same_twice_and_comes_back_from_its_file(tmp_path) -> None:
    found = plan_effects(EffectsConfig(), chunk(), cameras())
    again = plan_effects(EffectsConfig(), chunk(), cameras())
    assert repr(found) == repr(again)
    codec.write(tmp_path, found)
    assert repr(codec.read(tmp_path)) == repr(found)
