"""What a scene looks like in numbers, and warnings about it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from genre_tasks.exchange.clouds import transform_cloud
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.scene_survey import find_scene_warnings, survey_node
from genre_tasks.exchange.types import SplatCloud
from tests.exchange.splat_clouds import change_one, make_cloud, make_driving_scene


def make_street(thickness: float = 0.1) -> SplatCloud:
    """A road of 60 by 12 metres with two facades of 10 metres, of flat Gaussians; z is up."""
    random = np.random.default_rng(0)
    count = 3000
    cloud = make_cloud(count, seed=1)
    means = random.uniform([-30, -6, -0.02], [30, 6, 0.02], (count, 3))
    wall = np.arange(count) > 0.7 * count
    means[wall, 1] = np.where(random.random(wall.sum()) < 0.5, -6, 6)
    means[wall, 2] = random.uniform(0, 10, wall.sum())
    # The thin axis is z on the road and y on a facade.
    scales = np.log(np.full((count, 3), 0.2))
    scales[np.arange(count), np.where(wall, 1, 2)] += np.log(thickness)
    quats = np.tile([1.0, 0, 0, 0], (count, 1))
    return replace(
        cloud,
        means=means.astype(np.float32),
        log_scales=scales.astype(np.float32),
        quats=quats.astype(np.float32),
        logit_opacities=np.full(count, 3, np.float32),
        antialiased=False,
    )


def turn(cloud: SplatCloud, axis: str, degrees: float) -> SplatCloud:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return transform_cloud(cloud, pose)


def test_a_street_with_z_up_is_fine() -> None:
    for degrees in (0, 30, 90):
        assert find_scene_warnings(make_resting_scene(turn(make_street(), "z", degrees))) == ()


@pytest.mark.parametrize(("degrees", "word"), [(-90, "up"), (90, "down")])
def test_a_street_with_another_axis_up_is_named(degrees: float, word: str) -> None:
    (warning,) = find_scene_warnings(make_resting_scene(turn(make_street(), "x", degrees)))
    assert f"y pointed {word}" in warning


def test_a_cloud_without_a_ground_has_no_axis() -> None:
    assert find_scene_warnings(make_resting_scene(replace(make_cloud(2000), antialiased=True))) == ()


def test_discs_sizes_and_distances_are_named() -> None:
    street = make_street()
    cases = (
        (make_street(thickness=1e-4), "flat discs"),
        (change_one(street, "log_scales", 5.0), "1 Gaussians are larger than 50 m"),
        (change_one(street, "means", 3e4), "1 Gaussians are more than 20 km away"),
        (replace(street, antialiased=None), "anti-aliased"),
        (SplatCloud.empty(), "no Gaussians"),
    )
    for cloud, words in cases:
        (warning,) = find_scene_warnings(make_resting_scene(cloud))
        assert words in warning


def test_the_far_shell_may_be_large() -> None:
    scene = make_driving_scene()
    nodes = tuple(replace(node, cloud=replace(node.cloud, antialiased=True)) for node in scene.nodes)
    shell = replace(nodes[1], cloud=change_one(nodes[1].cloud, "log_scales", 5.0))
    assert find_scene_warnings(replace(scene, nodes=(nodes[0], shell, *nodes[2:]))) == ()


def test_a_quaternion_of_zeros_is_no_fault() -> None:
    street = make_street()
    scales = street.log_scales.copy()
    scales[:, 2] -= 3
    flat = replace(street, log_scales=scales, quats=np.where(np.arange(len(street))[:, None] == 7, 0, street.quats))
    whole = replace(flat, quats=street.quats)
    assert find_scene_warnings(make_resting_scene(flat)) == find_scene_warnings(make_resting_scene(whole))


def test_a_node_in_numbers() -> None:
    street = survey_node(make_resting_scene(make_street()).nodes[0])
    assert street.gaussians == 3000 and street.sh_degree == 0 and not street.moves
    np.testing.assert_allclose(street.extent_m, [59, 12, 10], rtol=0.05)
    np.testing.assert_allclose(street.opacity, 1 / (1 + np.exp(-3)), rtol=1e-5)
    np.testing.assert_allclose(street.scale_m, 0.2, rtol=1e-5)
    moving = survey_node(make_driving_scene(2).nodes[2])
    assert moving.moves and moving.sh_degree == 2 and moving.name == "car-1"
    assert survey_node(make_resting_scene(SplatCloud.empty()).nodes[0]).scale_m == (0, 0)
