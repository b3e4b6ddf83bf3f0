"""At the size of a real scene, where torch splits its loops, results do not depend on the thread count."""

from __future__ import annotations

import threading

import torch

from genre_tasks.scene.gaussians import sigmoid
from genre_tasks.threads import map_single_threaded, torch_threads


def test_sigmoid_is_the_same_bits_at_any_thread_count_and_bounded() -> None:
    logits = torch.randn(39_666, generator=torch.Generator().manual_seed(0)) * 5
    before, results = torch.get_num_threads(), []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(sigmoid(logits))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(results[0], results[1]) and torch.equal(results[0], results[2])
    torch.testing.assert_close(results[0], torch.sigmoid(logits), atol=1e-7, rtol=1e-6)


def test_sigmoid_of_extreme_logits_has_a_finite_gradient() -> None:
    x = torch.tensor([-torch.inf, -1e4, -80.0, 0.0, 80.0, 1e4], requires_grad=True)
    value = sigmoid(x)
    value.sum().backward()
    assert bool(((value >= 0) & (value <= 1)).all()) and bool(torch.isfinite(x.grad).all())
    assert bool(torch.isnan(sigmoid(torch.tensor([torch.nan]))).all())


def test_items_stay_on_one_thread_while_another_thread_restores_the_number() -> None:
    begun, restored = threading.Event(), threading.Event()

    def restore() -> None:
        with torch_threads(1):
            begun.wait()
        restored.set()

    def count(_: int) -> int:
        begun.set()
        restored.wait()
        return torch.get_num_threads()

    with torch_threads(3):
        other = threading.Thread(target=restore)
        other.start()
        assert map_single_threaded(count, [0, 1]) == [1, 1]
        other.join()
