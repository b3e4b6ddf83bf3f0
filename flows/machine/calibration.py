"""How fast this machine is now, by a fixed piece of work of the pipeline's kinds."""

from __future__ import annotations

import time

REPEATS = 3
GAUSSIANS, WIDTH_PX, HEIGHT_PX, VIEWS = 20_000, 320, 180, 4


def calibration_s() -> float:
    """Seconds of some renders with their gradients and of convolutions as the fixer's: the fastest of a few tries.

    The work is the same everywhere, so that the ratio of two machines' seconds is that of their speeds.
    """
    import torch

    from genre_tasks.render import Cameras, RenderSettings, render
    from genre_tasks.scene.gaussians import Splats

    g = torch.Generator().manual_seed(0)
    means = torch.rand((GAUSSIANS, 3), generator=g) * torch.tensor([20.0, 10.0, 40.0]) - torch.tensor([10.0, 5.0, -4.0])
    quats = torch.nn.functional.normalize(torch.randn((GAUSSIANS, 4), generator=g), dim=1)
    colors = torch.rand((GAUSSIANS, 3), generator=g)
    splats = Splats(means, torch.full((GAUSSIANS, 3), 0.08), quats, torch.full((GAUSSIANS,), 0.6), colors)
    leaves = [t.requires_grad_() for t in (splats.means, splats.scales, splats.opacities, splats.colors)]
    focal, center = torch.full((VIEWS, 2), 250.0), torch.tensor([[WIDTH_PX / 2, HEIGHT_PX / 2]]).repeat(VIEWS, 1)
    cameras = Cameras(torch.eye(4).repeat(VIEWS, 1, 1), focal, center, WIDTH_PX, HEIGHT_PX)
    image = torch.rand((VIEWS, 32, HEIGHT_PX // 2, WIDTH_PX // 2), generator=g)
    weight = torch.randn((32, 32, 3, 3), generator=g) / 17
    taken = []
    for _ in range(REPEATS + 1):  # the first loads the kernel
        begun = time.perf_counter()
        torch.autograd.grad(render(splats, cameras, RenderSettings("cpu")).color.sum(), leaves)
        with torch.no_grad():
            for _ in range(4):
                image = torch.nn.functional.conv2d(image, weight, padding=1).tanh()
        taken.append(time.perf_counter() - begun)
    return min(taken[1:])
