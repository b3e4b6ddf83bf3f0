"""At the size of a real scene, where torch splits its loops, results do not depend on the thread count."""

from __future__ import annotations

import torch

from genre_tasks.scene.gaussians import sigmoid


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
