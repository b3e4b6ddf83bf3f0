"""How fast this machine is now, by a fixed piece of work of the kinds that the pipeline does."""

from __future__ import annotations

import time

REPEATS = 3
GAUSSIANS = 20_000
VIEWS = 4
WIDTH_PX = 320
HEIGHT_PX = 180


def measure_calibration_s() -> float:
    """Times a fixed piece of work: renders with their gradients, and convolutions like the fixer's.

    The work is the same on every machine, so the ratio of two machines' seconds is the ratio of their speeds.

    Returns:
        Wall time in seconds, the fastest of a few repetitions.
    """
    import torch

    from genre_tasks.render import Cameras, RenderSettings, render
    from genre_tasks.scene.gaussians import Splats

    generator = torch.Generator().manual_seed(0)
    extent_m = torch.tensor([20.0, 10.0, 40.0])
    corner_m = torch.tensor([10.0, 5.0, -4.0])
    means = torch.rand((GAUSSIANS, 3), generator=generator) * extent_m - corner_m
    quats = torch.nn.functional.normalize(torch.randn((GAUSSIANS, 4), generator=generator), dim=1)
    colors = torch.rand((GAUSSIANS, 3), generator=generator)
    splats = Splats(means, torch.full((GAUSSIANS, 3), 0.08), quats, torch.full((GAUSSIANS,), 0.6), colors)
    leaves = [t.requires_grad_() for t in (splats.means, splats.scales, splats.opacities, splats.colors)]
    focal = torch.full((VIEWS, 2), 250.0)
    center = torch.tensor([[WIDTH_PX / 2, HEIGHT_PX / 2]]).repeat(VIEWS, 1)
    cameras = Cameras(torch.eye(4).repeat(VIEWS, 1, 1), focal, center, WIDTH_PX, HEIGHT_PX)
    image = torch.rand((VIEWS, 32, HEIGHT_PX // 2, WIDTH_PX // 2), generator=generator)
    weight = torch.randn((32, 32, 3, 3), generator=generator) / 17
    seconds = []
    # One repetition more than is counted: the first one loads the kernel.
    for _ in range(REPEATS + 1):
        start = time.perf_counter()
        torch.autograd.grad(render(splats, cameras, RenderSettings("cpu")).color.sum(), leaves)
        with torch.no_grad():
            for _ in range(4):
                image = torch.nn.functional.conv2d(image, weight, padding=1).tanh()
        seconds.append(time.perf_counter() - start)
    # Other processes can only make a repetition slower, so the fastest one is nearest to the machine's speed.
    return min(seconds[1:])
