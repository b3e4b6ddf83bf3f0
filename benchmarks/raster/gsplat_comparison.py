"""What is measured of the renderer's peers: gsplat's torch reference in turn with it, and gsplat on a GPU."""

from __future__ import annotations

import resource
import time

import torch

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.timing import Action, on_threads, ratio, take_turns
from benchmarks.raster.cells import THREADS, milliseconds, ours
from benchmarks.raster.gsplat_torch import forward_backward_peer, pairs_of, reference, render_peer
from benchmarks.raster.scenes import Case, forward, forward_backward, leaves_of, scene


def measure_peer(case: Case, rounds: int) -> Row:
    """gsplat's torch reference and the renderer in turn, on two threads, and how far their images differ.

    Listing the peer's pairs is in neither's time; it is a number of its own.
    """
    gsplat = reference()
    s = scene(case)
    torch.set_num_threads(THREADS)
    start = time.perf_counter()
    pairs = pairs_of(gsplat, s)
    listing_s = time.perf_counter() - start
    leaves = leaves_of(s.splats)

    @torch.no_grad()
    def peer_forward() -> tuple[torch.Tensor, torch.Tensor]:
        return render_peer(gsplat, s.splats, s, pairs)

    actions: dict[str, Action] = {}
    actions["forward"], actions["forward+backward"] = ours(s, THREADS)
    actions["gsplat forward"] = on_threads(THREADS, peer_forward)
    actions["gsplat forward+backward"] = on_threads(THREADS, lambda: forward_backward_peer(gsplat, leaves, s, pairs))
    seconds = take_turns(actions, rounds)
    (image, alpha), own = peer_forward(), forward(s, THREADS)
    return {
        "gaussians": case.count,
        "pairs": len(pairs.gaussians),
        "seconds_to_list_pairs": listing_s,
        "milliseconds": milliseconds(seconds),
        "forward_ratio": ratio(seconds["gsplat forward"], seconds["forward"]).as_row(),
        "ratio": ratio(seconds["gsplat forward+backward"], seconds["forward+backward"]).as_row(),
        "max_difference": {
            "color": float((own.color - image[..., :3]).abs().max()),
            "alpha": float((own.alpha - alpha[..., 0]).abs().max()),
            "depth_m": float((own.depth - image[..., 3]).abs().max()),
        },
        "mean_difference": {"color": float((own.color - image[..., :3]).abs().mean())},
        "process_peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }


def measure_cuda(case: Case, rounds: int) -> Row:
    """gsplat's CUDA rasterizer through the same function. Raises ``NotMeasuredError`` without a GPU or gsplat."""
    if not torch.cuda.is_available():
        raise NotMeasuredError("no GPU: torch.cuda.is_available() is false")
    reference()
    from gsplat.cuda._backend import _C

    if _C is None:
        raise NotMeasuredError("gsplat found no CUDA toolkit to compile its code with")
    s = scene(case, device="cuda")
    leaves = leaves_of(s.splats)

    def finished(action: Action) -> Action:
        def run() -> None:
            action()
            torch.cuda.synchronize()

        return run

    actions = {
        "forward": finished(lambda: forward(s, None)),
        "forward+backward": finished(lambda: forward_backward(s, leaves, None)),
    }
    return {"gaussians": case.count, "milliseconds": milliseconds(take_turns(actions, rounds))}
