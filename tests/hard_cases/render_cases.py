"""Hard cases 1–12 as scenes: each line is compared with the float64 reference by ``test_against_float64``.

To add a case, add a line: its number, its words, its scene, and what is culled.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from genre_tasks.render import Cameras
from genre_tasks.scene.gaussians import Splats
from tests.scenes import Scene, cloud, street


@dataclass(frozen=True)
class Case:
    """A scene, how many Gaussians are culled for which reason, and the bounds outside of the threshold band.

    ``image`` bounds the error of colour, alpha, and depth by the farthest depth; ``gradient`` the relative L2 error of
    each attribute's gradient. ``bands`` are the bands of 16 rows that are compared, where the image is too large.
    """

    number: int
    words: str
    scene: Callable[[], Scene]
    culled: dict[str, int] = field(default_factory=dict, hash=False)
    image: float = 1e-5
    gradient: float = 1e-5
    bands: tuple[int, ...] | None = None
    share: float = 0.1  # at most so much of the image may be threshold band
    whole: bool = False  # measure the gradient with the band, too
    light: bool = True  # compare the float32 reference, too


Change = Callable[[Splats, Tensor], Splats]


def among_others(
    change: Change, n: int = 300, width: int = 33, height: int = 17, every: int = 7
) -> Callable[[], Scene]:
    """The cloud, of which every seventh Gaussian (a mask) is changed."""

    def scene() -> Scene:
        splats, cameras = cloud(n, width, height)
        return change(splats, torch.arange(n) % every == 0), cameras

    return scene


def _sizes(size: float, *axes: int) -> Change:
    def change(s: Splats, hard: Tensor) -> Splats:
        scales = s.scales.clone()
        for axis in axes:
            scales[hard, axis] = size
        return replace(s, scales=scales)

    return change


def _places(*place: float) -> Change:
    return lambda s, hard: replace(s, means=torch.where(hard[:, None], torch.tensor(place), s.means))


def _lengths(*factors: float) -> Change:
    def change(s: Splats, hard: Tensor) -> Splats:
        each = torch.tensor(factors)[torch.arange(len(s)) % len(factors)]
        return replace(s, quats=torch.where(hard[:, None], s.quats * each[:, None], s.quats))

    return change


def _opacity(value: float) -> Change:
    return lambda s, hard: replace(s, opacities=torch.where(hard, torch.tensor(value), s.opacities))


def needles(s: Splats, hard: Tensor) -> Splats:
    """Ten times as long as the others and 1e-4 as thick, in any direction."""
    thin = s.scales[:, :1] * torch.tensor([[10.0, 1e-3, 1e-3]])
    return replace(s, scales=torch.where(hard[:, None], thin, s.scales))


def _any_size(s: Splats, hard: Tensor) -> Splats:
    g = torch.Generator().manual_seed(3)
    return replace(
        s, scales=torch.where(hard[:, None], torch.exp(70 * torch.rand(len(s), 3, generator=g) - 30), s.scales)
    )


def _straddling(s: Splats, hard: Tensor) -> Splats:
    """Centres within half a metre of the camera, a metre large, faint enough to see through."""
    n = len(s)
    g = torch.Generator().manual_seed(4)
    near = (torch.rand(n, 3, generator=g) - torch.tensor([0.5, 0.5, 0.0])) * 0.5 + torch.tensor([0.0, 0.0, 0.05])
    s = _opacity(0.05)(s, hard)
    return replace(
        s,
        means=torch.where(hard[:, None], near, s.means),
        scales=torch.where(hard[:, None], s.scales.new_ones(1), s.scales),
    )


def _far(s: Splats, hard: Tensor) -> Splats:
    """4e3 to 1.2e5 m ahead, as large in the image as before."""
    factor = torch.where(hard[:, None], 2000.0, 1.0)
    return replace(s, means=s.means * factor, scales=s.scales * factor)


def _off_axis(s: Splats, hard: Tensor) -> Splats:
    """At three times the slope of the image's edge on both axes, large enough to reach into the image."""
    n = len(s)
    z = s.means[:, 2]
    side = torch.where(torch.arange(n) % 2 == 0, 1.0, -1.0)
    place = torch.stack([side * 3 * 0.5 / 0.7 * z, side * 3 * 0.5 * 17 / 33 / 0.7 * z, z], 1)
    return replace(
        s,
        means=torch.where(hard[:, None], place, s.means),
        scales=torch.where(hard[:, None], 0.9 * z[:, None] * torch.tensor([[1.0, 1.2, 0.8]]), s.scales),
    )


def _footprint(pixels: float) -> Change:
    def change(s: Splats, hard: Tensor) -> Splats:
        size = s.means[:, 2:] * pixels / (0.7 * 33) * torch.tensor([[1.0, 0.8, 1.3]])
        return replace(s, scales=torch.where(hard[:, None], size, s.scales))

    return change


def _coincident(s: Splats, hard: Tensor) -> Splats:
    return replace(s, means=torch.where(hard[:, None], s.means[:1], s.means))


def _one_depth() -> Scene:
    splats, cameras = cloud(200)
    means = splats.means * torch.tensor([1.0, 1.0, 0.0]) + torch.tensor([0.0, 0.0, 9.0])
    return replace(splats, means=means), replace(cameras, camera_SE3_chunk=torch.eye(4)[None])


def layers(n: int, opacity: float) -> Scene:
    """n layers a millimetre apart, wide enough to be nearly flat over the image."""
    g = torch.Generator().manual_seed(6)
    means = torch.zeros(n, 3)
    means[:, 2] = 5 + 1e-3 * torch.arange(n)
    splats = Splats(
        means,
        2 + torch.rand(n, 3, generator=g),
        torch.randn(n, 4, generator=g),
        torch.full((n,), opacity),
        torch.rand(n, 3, generator=g),
    )
    return splats, Cameras(torch.eye(4)[None], torch.full((1, 2), 10.0), torch.full((1, 2), 4.5), 9, 9)


def needles_only(n: int, width: int, height: int) -> Scene:
    """The street's Gaussians, each three times as long and 1e-4 as thick as that."""
    splats, cameras = street(n, width, height)
    size = splats.scales[:, :1].clamp(max=0.5)
    return replace(splats, scales=size * torch.tensor([[3.0, 3e-4, 3e-4]])), cameras


_ODD_SIZES = ((1, 1), (17, 33), (1, 64), (64, 1), (15, 16))
_BANDS = (5, 11, 15)
_SEVENTHS = 43  # of 300
GEOMETRY = (
    Case(1, "quaternion zero", among_others(_lengths(0.0)), {"quaternion": _SEVENTHS}),
    Case(1, "quaternion of length 1e-4", among_others(_lengths(1e-4 / 2)), {"quaternion": _SEVENTHS}),
    Case(1, "quaternion times −1, 0.01, 8, 1e18 or −1e30", among_others(_lengths(-1.0, 1e-2, 8.0, 1e18, -1e30))),
    Case(2, "log-scale −30 on one axis", among_others(_sizes(math.exp(-30), 1))),
    Case(2, "log-scale −30 on all axes", among_others(_sizes(math.exp(-30), 0, 1, 2))),
    Case(2, "one axis exactly 0", among_others(_sizes(0.0, 2))),
    Case(2, "two axes exactly 0", among_others(_sizes(0.0, 0, 2))),
    Case(2, "all axes exactly 0", among_others(_sizes(0.0, 0, 1, 2))),
    Case(2, "scale 10 m on one axis", among_others(_sizes(10.0, 0))),
    Case(2, "scale 1e4 m on one axis", among_others(_sizes(1e4, 0)), share=0.6),
    Case(2, "scale 1e4 m on all axes", among_others(_sizes(1e4, 0, 1, 2))),
    Case(2, "log-scale 40 on one axis", among_others(_sizes(math.exp(40), 0)), {"degenerate": _SEVENTHS}),
    Case(2, "log-scale 40 on all axes", among_others(_sizes(math.exp(40), 0, 1, 2)), {"degenerate": _SEVENTHS}),
    Case(2, "log-scales from −30 to 40", among_others(_any_size), {"degenerate": 25}),
    Case(2, "anisotropy 1e4 (needles)", among_others(needles)),
    Case(3, "mean at the camera centre", among_others(_places(0.0, 0.0, 0.0)), {"behind": _SEVENTHS}),
    Case(3, "mean just behind the near plane", among_others(_places(0.0, 0.0, 0.0099)), {"behind": _SEVENTHS}),
    Case(3, "mean just ahead of the near plane", among_others(_places(0.001, 0.0, 0.0105)), gradient=5e-4),
    Case(3, "mean behind the camera", among_others(_places(1.0, 0.5, -3.0)), {"behind": _SEVENTHS}),
    Case(3, "straddling the camera", among_others(_straddling), gradient=5e-5),
    Case(4, "4e3 to 1.2e5 m away", among_others(_far)),
    Case(4, "1.4e5 m away to the side", among_others(_places(1e5, 0.0, 1e5))),
    Case(4, "at 1e30 m", among_others(_places(1e30, -1e30, 1e30))),
    Case(4, "at 4e6 m to the side", among_others(_places(4e6, 4e6, 50.0)), {"behind": _SEVENTHS}),
    Case(5, "three times the field of view off-axis", among_others(_off_axis)),
    Case(6, "footprint of 0.01 px", among_others(_footprint(0.01))),
    Case(6, "footprint of ten images", among_others(_footprint(330.0))),
    Case(7, "no Gaussian", lambda: cloud(0, 33, 17, views=2)),
    Case(7, "one Gaussian", lambda: cloud(1, 33, 17)),
    *(Case(7, f"{w}×{h} px", lambda w=w, h=h: cloud(300, w, h)) for w, h in _ODD_SIZES),
    Case(7, "300 Gaussians, two views", lambda: cloud(300, views=2), whole=True),
    Case(7, "20 000 Gaussians, a cloud", lambda: cloud(20_000, 240, 160), whole=True, light=False),
    Case(7, "20 000 Gaussians, a street", lambda: street(20_000, 240, 160), {"behind": 3}),
    Case(
        7,
        "100 000 Gaussians, a cloud (bands)",
        lambda: cloud(100_000, 480, 320),
        bands=_BANDS,
        whole=True,
        light=False,
    ),
    Case(
        7,
        "100 000 Gaussians, a street (bands)",
        lambda: street(100_000, 480, 320),
        {"behind": 18},
        bands=_BANDS,
        whole=True,
        light=False,
    ),
    Case(8, "43 coincident Gaussians", among_others(_coincident)),
    Case(8, "200 Gaussians of one depth", _one_depth),
)
COMPOSITING = (
    Case(11, "opacity 0", among_others(_opacity(0.0))),
    Case(11, "opacity just below 1/255", among_others(_opacity(0.0039))),
    Case(11, "opacity exactly 1", among_others(_opacity(1.0))),
    Case(11, "every opacity exactly 1", among_others(_opacity(1.0), every=1)),
    Case(12, "30 000 layers of opacity 0.005", lambda: layers(30_000, 0.005)),
    Case(12, "30 000 layers of opacity 1", lambda: layers(30_000, 1.0)),
)
