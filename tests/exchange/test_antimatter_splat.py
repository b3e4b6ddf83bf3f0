"""Files of 32 bytes a Gaussian."""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from genre_tasks.errors import InputError
from genre_tasks.exchange.activations import colors_to_sh_dc, opacities_to_logits
from genre_tasks.exchange.antimatter_splat import SPLAT
from genre_tasks.exchange.cloud_errors import CloudErrors
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.types import SplatCloud
from genre_tasks.metrics.image_quality import psnr
from genre_tasks.render import RenderSettings, render
from genre_tasks.scene.gaussians import Splats
from tests.exchange.format_suite import FormatSuite
from tests.exchange.splat_clouds import make_cloud
from tests.scenes import street

MOST_DIFFERENCE = 2 / 255
LEAST_PSNR_DB = 40.0


class TestAntimatterSplat(FormatSuite):
    name = "splat"
    sh_degrees = (0,)
    keeps_antialiasing = False
    cut_attributes = frozenset({"sh_dc"})
    # Half a step of 128 in each of four components, and half a step of 256.
    tolerances = CloudErrors(
        means_m=0, log_scales=1e-6, angles_rad=0.018, opacities=0.5 / 255 + 1e-6, colors=0.5 / 255 + 1e-6, sh_rest=0
    )


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene.splat"


def pack(
    position: tuple[float, ...] = (1.0, 2.0, 3.0),
    scale: tuple[float, ...] = (1.0, 1.0, 1.0),
    rgba: tuple[int, ...] = (0, 255, 128, 255),
    quat: tuple[int, ...] = (255, 128, 128, 128),
) -> bytes:
    return struct.pack("<6f8B", *position, *scale, *rgba, *quat)


def test_a_file_of_another_tool(path: Path) -> None:
    path.write_bytes(pack() + pack(scale=(0.5, 2.0, 1.0), rgba=(255, 0, 0, 0), quat=(128, 128, 128, 0)))
    cloud = SPLAT.read(path).nodes[0].cloud
    assert cloud.means.tolist() == [[1, 2, 3], [1, 2, 3]]
    np.testing.assert_allclose(cloud.log_scales, [[0, 0, 0], [np.log(0.5), np.log(2), 0]], atol=1e-7)
    np.testing.assert_allclose(cloud.quats, [[1, 0, 0, 0], [0, 0, 0, -1]])
    np.testing.assert_allclose(cloud.sh_dc * 0.28209479 + 0.5, [[0, 1, 128 / 255], [1, 0, 0]], atol=1e-6)
    # Opacities of 0 and 1 have no finite logit.
    np.testing.assert_allclose(cloud.logit_opacities, [13.8, -13.8], atol=0.1)


def test_what_is_written_of_plain_values(path: Path) -> None:
    cloud = SplatCloud(
        means=np.array([[1.5, -2.0, 0.25]], np.float32),
        log_scales=np.zeros((1, 3), np.float32),
        quats=np.array([[0, 3, 0, 0]], np.float32),
        logit_opacities=opacities_to_logits(np.array([0.4])),
        sh_dc=colors_to_sh_dc(np.array([[0.2, 0.4, 0.6]])),
        sh_rest=np.zeros((1, 0, 3), np.float32),
    )
    SPLAT.write(path, make_resting_scene(cloud))
    # 1 does not fit into a component, and −1 does.
    expected = pack((1.5, -2.0, 0.25), (1, 1, 1), (51, 102, 153, 102), (128, 0, 128, 128))
    assert path.read_bytes() == expected


@pytest.mark.parametrize(
    ("damaged", "words"),
    [
        (pack()[:-1], "31 bytes"),
        (pack(position=(np.nan, 0.0, 0.0)), "means is not finite in 1"),
        (pack(scale=(np.inf, 1.0, 1.0)), "scales is not finite in 1"),
        (pack() + pack(scale=(1.0, 0.0, 1.0)), "scales of 1 Gaussians are not above 0, the first is number 1"),
        (pack(scale=(1.0, -1.0, 1.0)), "not above 0"),
    ],
)
def test_hostile_files(path: Path, damaged: bytes, words: str) -> None:
    path.write_bytes(damaged)
    with pytest.raises(InputError, match=words) as caught:
        SPLAT.read(path)
    assert caught.value.file == str(path)


def test_scales_that_float32_does_not_hold(path: Path) -> None:
    for value in (100.0, -100.0):
        cloud = replace(make_cloud(3), log_scales=np.array([[0, 0, 0], [0, value, 0], [0, 0, 0]], np.float32))
        with pytest.raises(InputError, match="scales of 1 Gaussians do not fit into float32, the first is number 1"):
            SPLAT.write(path, make_resting_scene(cloud))


def test_losses_are_counted() -> None:
    cloud = replace(make_cloud(10, 3), antialiased=True)
    cloud.sh_dc[:4] = 3.0
    losses = " ".join(SPLAT.describe_losses(make_resting_scene(cloud)))
    assert "256 steps" in losses
    assert "degree 3 are left out" in losses
    assert "4 of 10 Gaussians are cut" in losses
    assert "anti-aliasing is left out" in losses


def test_a_street_looks_the_same(path: Path) -> None:
    splats, cameras = street(3000, 160, 90)
    count = len(splats)
    cloud = SplatCloud(
        means=splats.means.numpy(),
        log_scales=splats.scales.log().numpy(),
        quats=splats.quats.numpy(),
        logit_opacities=opacities_to_logits(splats.opacities.double().numpy()),
        sh_dc=colors_to_sh_dc(splats.colors.double().numpy()),
        sh_rest=np.zeros((count, 0, 3), np.float32),
    )
    SPLAT.write(path, make_resting_scene(cloud))
    found = SPLAT.read(path).nodes[0].cloud
    after = Splats(
        torch.from_numpy(found.means),
        torch.from_numpy(found.log_scales).exp(),
        torch.from_numpy(found.quats),
        torch.from_numpy(found.logit_opacities).sigmoid(),
        torch.from_numpy(0.5 + 0.28209479177387814 * found.sh_dc),
    )
    images = [render(s, cameras, RenderSettings(threads=1)).color[0].numpy().clip(0, 1) for s in (splats, after)]
    assert np.abs(images[0] - images[1]).mean() <= MOST_DIFFERENCE
    assert psnr(images[1], images[0]) >= LEAST_PSNR_DB
    assert not np.array_equal(images[0], images[1])
