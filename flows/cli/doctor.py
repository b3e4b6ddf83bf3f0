"""``genre doctor``: what this machine has, and what each missing piece would enable."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import json
import os
import platform
from typing import Annotated, Any

import typer

_OPTIONAL = {
    "gsplat": ("GPU rendering (needs CUDA)", "pip install 'genre[cuda]'"),
    "peft": ("LoRA fine-tuning and SD-Turbo's adapters", "pip install 'genre[sd-turbo]'"),
    "transformers": ("loading SD-Turbo", "pip install 'genre[sd-turbo]'"),
    "pandas": ("writing logs in the PandaSet layout", "pip install pandas"),
}
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


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object to stdout.")] = False,
) -> None:
    """Say what this machine has (cores, memory, GPU, weights, packages) and what missing pieces would enable."""
    found = {**_machine(), "renderer": _renderer(), "weights": _weights(), "packages": _packages()}
    if as_json:
        typer.echo(json.dumps(found))
        return
    from flows.cli.printing import print_fields

    print_fields("genre doctor", found)


def _machine() -> dict[str, Any]:
    import psutil

    from flows.machine.memory import memory_limit_gib

    total = psutil.virtual_memory().total / 2**30
    out: dict[str, Any] = {
        "python": platform.python_version(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory": f"{total:.1f} GiB, of which this process may use {memory_limit_gib():.1f}",
    }
    import torch

    if torch.cuda.is_available():
        out["gpu"] = f"{torch.cuda.get_device_name()}: used for rendering and training"
    else:
        out["gpu"] = "none: everything runs on the CPU; with one, `genre` renders with gsplat and trains faster"
    return out


def _renderer() -> str:
    from genre_tasks.errors import GenreError

    try:
        from genre_tasks.compiled.loader import candidate_isas
        from genre_tasks.render.kernel.library import load_kernel

        load_kernel()
        return f"cpu kernel, {candidate_isas()[0]}"
    except GenreError as error:
        return f"cpu kernel cannot be loaded: {error}"


def _weights() -> dict[str, str]:
    from genre_tasks.errors import GenreError
    from genre_tasks.weights import resolve_weights

    out = {}
    for name in ("gnet", "fnet", "enet"):
        try:
            path = resolve_weights(name, "builtin")
            out[name] = f"{path.name}, {path.stat().st_size / 2**20:.1f} MiB"
        except GenreError as error:
            out[name] = str(error)
    return out


def _packages() -> dict[str, str]:
    out = {}
    for name in _REQUIRED:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "missing: run `make setup`"
    for name, (enables, how) in _OPTIONAL.items():
        present = importlib.util.find_spec(name) is not None
        out[name] = importlib.metadata.version(name) if present else f"missing; would enable {enables}: {how}"
    return out
