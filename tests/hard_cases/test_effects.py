"""Hard cases 50 and 51: a distortion that folds back, a near plane crossed during the readout, a readout of 0."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from genre_tasks.logs.types import RollingShutter
from genre_tasks.render import Cameras, render
from genre_tasks.render.types import Shutter
from genre_tasks.scene.gaussians import Splats
from genre_tasks.scene.lens_distortion import fold_radius
from tests.hard_cases.case_measurements import CROSSING, FOLDING, NO_READOUT
from tests.hard_cases.comparison import REFERENCE, SETTINGS, changed_bits, different, on_both, worst
from tests.render.oracles import agreement, survey
from tests.scenes import NAMES, Scene, cloud, gradients

BARREL = (-0.3, 0.0, 0.001, -0.002, 0.0)
TOWARDS = RollingShutter(0.03, velocity_m_s=(0.0, 0.5, 30.0), turn_rad_s=(0.1, -0.2, 0.3))


def _around(radius: float) -> Scene:
    """Each seventh Gaussian of the cloud lies on a ring of x/z and y/z, large enough to reach into the image."""
    splats, cameras = cloud(300, 33, 17)
    camera = replace(cameras, distortion=torch.tensor([BARREL]), camera_SE3_chunk=torch.eye(4)[None])
    angle = torch.arange(300) * 0.7
    ring = 5 * torch.stack([radius * angle.cos(), radius * angle.sin(), torch.ones(300)], 1)
    hard = (torch.arange(300) % 7 == 0)[:, None]
    means, scales = torch.where(hard, ring, splats.means), torch.where(hard, 2.0, splats.scales)
    return replace(splats, means=means, scales=scales), camera


def _compared(splats: Splats, cameras: Cameras, backend: str, row, stability) -> tuple[dict[str, int], dict]:
    seen = survey(splats, cameras)
    truth, exact = gradients(splats, cameras, REFERENCE, torch.float64, ~seen.band)
    image, found = gradients(splats, cameras, SETTINGS[backend], mask=~seen.band)
    assert all(bool(x.isfinite().all()) for x in (image.color, image.alpha, image.depth, *found.values()))
    assert image.culled == truth.culled
    stability.record(row, backend, max(agreement(image, truth, seen.band).outside, worst(found, exact)))
    return image.culled, found


@on_both
@pytest.mark.parametrize(("share", "culled"), [(0.9, {}), (0.99, {}), (1.01, {"folded": 43}), (3.0, {"folded": 43})])
def test_what_lies_beyond_the_fold_is_culled(backend, share, culled, stability):
    splats, cameras = _around(share * fold_radius(BARREL))
    counts, found = _compared(splats, cameras, backend, FOLDING, stability)
    assert counts == culled
    hard = torch.arange(300) % 7 == 0
    assert bool(found["means"][hard].any()) == (not culled)


@on_both
def test_what_would_fold_back_touches_no_pixel(backend):
    """Its polynomial would put it into the middle of the image: r (1 − 0.3 r²) is 0 at 1.83."""
    splats, cameras = _around(1.83)
    rest = torch.arange(300) % 7 != 0
    alone = Splats(*(getattr(splats, n)[rest] for n in NAMES))
    assert different(render(splats, cameras, SETTINGS[backend]), render(alone, cameras, SETTINGS[backend])) == 0


@on_both
@pytest.mark.parametrize("z", [0.011, 0.1, 0.3, 0.44, 0.6])
def test_crossing_the_near_plane_during_the_readout(backend, z, stability):
    """The camera comes 0.9 m nearer: a row of Gaussians from above the image to below it, some of which it passes."""
    splats, cameras = cloud(300, 33, 17)
    cameras = replace(cameras, camera_SE3_chunk=torch.eye(4)[None], shutter=Shutter.from_rolling_shutters([TOWARDS]))
    hard = torch.arange(300) % 7 == 0
    place = torch.stack([0.1 * torch.ones(300), z * torch.linspace(-0.6, 0.6, 300), torch.full((300,), z)], 1)
    means = torch.where(hard[:, None], place, splats.means)
    opacities = torch.where(hard, 0.05, splats.opacities)
    scales = torch.where(hard[:, None], 0.05 * z, splats.scales)
    moved = replace(splats, means=means, opacities=opacities, scales=scales)
    counts, found = _compared(moved, cameras, backend, CROSSING, stability)
    gone = counts.get("behind", 0)
    assert (0 < gone < 43) == (z < 0.45), counts
    assert int((hard & (found["means"] == 0).all(1)).sum()) >= gone
    behind = replace(moved, means=torch.where(hard[:, None], means * torch.tensor([1.0, 1.0, -1.0]), means))
    assert render(behind, cameras, SETTINGS[backend]).culled == {"behind": 43}, "also what is ahead at its row's time"


@on_both
def test_a_readout_of_0_is_no_shutter(backend, stability):
    splats, cameras = cloud(300, 33, 17, views=2)
    still = replace(cameras, shutter=Shutter.from_rolling_shutters([replace(TOWARDS, readout_s=0.0)] * 2))
    plain, expected = gradients(splats, cameras, SETTINGS[backend])
    for one in (still, replace(still, distortion=torch.zeros(2, 5))):
        image, found = gradients(splats, one, SETTINGS[backend])
        changed = different(plain, image) + sum(changed_bits(found[n], expected[n]) for n in NAMES)
        stability.record(NO_READOUT, backend, changed)
        assert changed == 0
