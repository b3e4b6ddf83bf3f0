"""FID and LPIPS proper: their formulas, on networks with the signatures of the published ones and other weights."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.linalg import sqrtm
from torch import Tensor, nn

from genre_tasks.errors import InputError, NonFiniteError
from genre_tasks.metrics.fid_lpips import FID_DIMENSIONS, Inception, ScriptedLpips, fid


class FakeInception(nn.Module):
    """Pooled pixels, laid out as 2048 features; classes where no features are asked for."""

    def forward(self, img: Tensor, return_features: bool = False, use_fp16: bool = False) -> Tensor:
        if not return_features:
            return torch.zeros(img.shape[0], 1008)
        assert img.dtype == torch.uint8
        pooled = F.adaptive_avg_pool2d(img.float() / 255, (8, 8)).flatten(1)
        return F.pad(pooled, [0, 2048 - pooled.shape[1]])


class NarrowInception(nn.Module):
    def forward(self, img: Tensor, return_features: bool = False) -> Tensor:
        return img.float().flatten(1)[:, :64]


class FakeVgg(nn.Module):
    """Half of the pixels' values of [0, 255], at full size."""

    def forward(self, img: Tensor, resize_images: bool = True, return_lpips: bool = False) -> Tensor:
        assert return_lpips and not resize_images
        return img.flatten(1) / 510


def saved(module: nn.Module, path: Path) -> str:
    torch.jit.script(module).save(str(path))
    return str(path)


def features(count: int, dimensions: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    mix = torch.randn(dimensions, dimensions, generator=generator).double()
    return torch.randn(count, dimensions, generator=generator).double() @ mix + seed


@pytest.mark.parametrize("count", [6, 90])
def test_fid_is_the_formula_with_a_matrix_square_root(count: int) -> None:
    a, b = features(count, 12, 1).numpy(), features(80, 12, 2).numpy()
    ca, cb = np.cov(a.T), np.cov(b.T)
    expected = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(ca + cb - 2 * sqrtm(ca @ cb).real)
    assert fid(torch.from_numpy(a), torch.from_numpy(b)) == pytest.approx(expected, rel=1e-5)


def test_fid_of_a_set_and_itself_is_nothing_and_of_one_image_undefined() -> None:
    x = features(20, 40, 3)
    assert fid(x, x.clone()) == pytest.approx(0.0, abs=1e-6 * float(x.square().sum()))
    assert fid(x[:1], x) is None
    with pytest.raises(NonFiniteError):
        fid(x * torch.nan, x)


def test_features_are_of_eight_bit_images_one_by_one(tmp_path: Path) -> None:
    network = Inception(saved(FakeInception(), tmp_path / "i.pt"))
    images = torch.rand(3, 32, 48, 3, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1
    found = network.features(images)
    assert found.shape == (3, FID_DIMENSIONS) and found.dtype == torch.float64
    pixels = (images.clamp(0, 1) * 255).round() / 255
    expected = F.adaptive_avg_pool2d(pixels.permute(0, 3, 1, 2), (8, 8)).flatten(1)
    assert torch.allclose(found[:, :192].float(), expected, atol=1e-6)
    assert network.features(images[:0]).shape == (0, FID_DIMENSIONS)


def test_lpips_is_the_squared_distance_of_what_the_network_gives(tmp_path: Path) -> None:
    network = ScriptedLpips(saved(FakeVgg(), tmp_path / "v.pt"))
    a, b = torch.zeros(2, 4, 5, 3), torch.zeros(2, 4, 5, 3)
    b[1] = 1.0
    assert network.distances(a, b) == [0.0, pytest.approx(60 * 0.25)]


def test_files_that_are_no_such_network_are_named(tmp_path: Path) -> None:
    (tmp_path / "text.pt").write_text("no")
    for file, message in (("none.pt", "no such file"), ("text.pt", "no TorchScript")):
        with pytest.raises(InputError, match=message) as caught:
            Inception(tmp_path / file)
        assert file in str(caught.value) and "evaluate.inception" in str(caught.value)
    with pytest.raises(InputError, match=r"takes self, img.*forward takes return_lpips"):
        ScriptedLpips(saved(FakeInception(), tmp_path / "i.pt"))
    narrow = Inception(saved(NarrowInception(), tmp_path / "n.pt"))
    with pytest.raises(InputError, match=r"\[1, 64\], expected \[1, 2048\]"):
        narrow.features(torch.zeros(1, 8, 8, 3))
