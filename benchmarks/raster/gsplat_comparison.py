"""What is measured of the renderer's peers: gsplat's torch reference in turn with it, and gsplat on a GPU."""

from __future__ import annotations

import resource
import time

import torch

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.timing import Action, on_threads, ratio, time_in_turns
from benchmarks.raster.cells import THREADS, milliseconds, renderer_actions
from benchmarks.raster.gsplat_torch import forward_backward_reference, list_pairs, load_reference, render_reference
from benchmarks.raster.scenes import Case, forward, forward_backward, gradient_leaves, scene


def measure_torch_reference(case: Case, rounds: int) -> Row:
    """Measures gsplat's torch reference and the renderer in turn, on two threads.

    Listing the reference's pairs is in neither's time; it is a number of its render.

    Args:
        case: scene to render.
        rounds: how often each action is timed.

    Returns:
        Times, their ratios, and how far the images differ.

    Raises:
        NotMeasuredError: gsplat, or this version of it, is not installed.
    """
    gsplat = load_reference()
    s = scene(case)
    # The list is made with as many threads as it would be in a render.
    torch.set_num_threads(THREADS)
    start = time.perf_counter()
    pairs = list_pairs(gsplat, s)
    listing_s = time.perf_counter() - start
    leaves = gradient_leaves(s.splats)

    @torch.no_grad()
    def peer_forward() -> tuple[torch.Tensor, torch.Tensor]:
        return render_reference(gsplat, s.splats, s, pairs)

    actions: dict[str, Action] = {}
    actions["forward"], actions["forward+backward"] = renderer_actions(s, THREADS)
    actions["gsplat forward"] = on_threads(THREADS, peer_forward)
    actions["gsplat forward+backward"] = on_threads(
        THREADS, lambda: forward_backward_reference(gsplat, leaves, s, pairs)
    )
    seconds = time_in_turns(actions, rounds)
    # Both images are compared too: a quick renderer that draws something else would prove nothing.
    image, alpha = peer_forward()
    render = forward(s, THREADS)
    return {
        "gaussians": case.count,
        "pairs": len(pairs.gaussians),
        "seconds_to_list_pairs": listing_s,
        "milliseconds": milliseconds(seconds),
        "forward_ratio": ratio(seconds["gsplat forward"], seconds["forward"]).as_row(),
        "ratio": ratio(seconds["gsplat forward+backward"], seconds["forward+backward"]).as_row(),
        "max_difference": {
            "color": float((render.color - image[..., :3]).abs().max()),
            "alpha": float((render.alpha - alpha[..., 0]).abs().max()),
            "depth_m": float((render.depth - image[..., 3]).abs().max()),
        },
        "mean_difference": {"color": float((render.color - image[..., :3]).abs().mean())},
        "process_peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def measure_cuda(case: Case, rounds: int) -> Row:
    """Measures gsplat's CUDA rasteriser through the same function.

    Args:
        case: scene to render.
        rounds: how often each action is timed.

    Returns:
        Times.

    Raises:
        NotMeasuredError: there is no GPU, gsplat or CUDA toolkit.
    """
    # Asked before gsplat is loaded, whose import would start to compile.
    if not torch.cuda.is_available():
        raise NotMeasuredError("no GPU: torch.cuda.is_available() is false")
    # Called for its check of the version alone.
    load_reference()
    # Importing gsplat compiles its code, so only a machine with a GPU does it.
    from gsplat.cuda._backend import _C

    if _C is None:
        raise NotMeasuredError("gsplat found no CUDA toolkit to compile its code with")
    s = scene(case, device="cuda")
    leaves = gradient_leaves(s.splats)

    # A CUDA call returns before its work is done; without the wait only the launch would be timed.
    def synchronised(action: Action) -> Action:
        def run() -> None:
            action()
            torch.cuda.synchronize()

        return run

    actions = {
        "forward": synchronised(lambda: forward(s, None)),
        "forward+backward": synchronised(lambda: forward_backward(s, leaves, None)),
    }
    return {"gaussians": case.count, "milliseconds": milliseconds(time_in_turns(actions, rounds))}
