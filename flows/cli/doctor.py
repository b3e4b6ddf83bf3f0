"""``genre doctor``: what this machine has, and what each missing piece would enable."""

from __future__ import annotations

import platform
import re
from typing import Any

from flows.cli.options import JsonOption

_EXTRAS = {
    "cuda": "training on a GPU (needs CUDA)",
    "sd-turbo": "SD-Turbo as the fixer, and its fine-tuning",
    "lpips": "LPIPS by evaluate.lpips=alex or vgg",
    "viewer": "`genre view`",
    "usd": "scenes in USD files",
    "perception": "detectors in ONNX and TFLite files",
    "simulators": "`genre serve`, and the driving environment",
    "metrics": "metrics for Prometheus",
    "services": "the S3 server of `genre ops up`",
}
"""What each extra enables; those for development and for comparisons are left out."""

_REQUIREMENT = re.compile(r"(?P<package>[\w.-]+)[^;]*(;.*extra\s*==\s*[\"'](?P<extra>[\w.-]+)[\"'])?")


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

    from flows.machine.facts import count_cores
    from flows.machine.memory import memory_limit_gib

    total_gib = psutil.virtual_memory().total / 2**30
    return {
        "python": platform.python_version(),
        # As runs count them: a container or a batch system may give fewer cores than the machine has.
        "cores": count_cores(),
        "memory": f"{total_gib:.1f} GiB, of which this process may use {memory_limit_gib():.1f}",
        "gpu": _describe_gpu(),
    }


def _describe_gpu() -> str:
    # What is missing is a finding of this command, which other messages name for a list of it.
    try:
        import torch
    except ImportError as error:
        return f"unknown, as torch cannot be imported: {error}"
    if torch.cuda.is_available():
        return f"{torch.cuda.get_device_name()}: used for training; a run computes on the CPU"
    return "none: everything runs on the CPU; only training could use one"


def _renderer() -> str:
    from genre_tasks.errors import GenreError

    # A kernel that cannot be loaded is a finding of this command and not an error, as is the torch that it needs.
    try:
        from genre_tasks.compiled.loader import candidate_instruction_sets
        from genre_tasks.render.kernel.library import load_kernel

        load_kernel()
        return f"cpu kernel, {candidate_instruction_sets()[0]}"
    except (GenreError, ImportError) as error:
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
    """The version of each package, or what it would enable and how it is installed."""
    from importlib.metadata import PackageNotFoundError

    packages = {}
    try:
        requirements = _read_requirements()
    except PackageNotFoundError:
        return {"genre": "is not installed, so that nothing lists its packages: run `make setup`"}
    for name, extras in requirements.items():
        if None in extras:
            packages[name] = _find_version(name) or "missing: run `make setup`, or `pip install genre` again"
            continue
        ways = [f"{_EXTRAS[extra]}: pip install 'genre[{extra}]'" for extra in extras if extra in _EXTRAS]
        if ways:
            packages[name] = _find_version(name) or f"missing; would enable {'; '.join(ways)}"
    # No command needs it, so no extra has it.
    reading = "missing; would enable reading the store's tables, as the quickstart does: pip install pandas"
    packages["pandas"] = _find_version("pandas") or reading
    return packages


def _read_requirements() -> dict[str, list[str | None]]:
    """By package, the extras that need it; ``None`` stands for what every installation needs."""
    # Here, as every command loads this module.
    from importlib.metadata import requires

    requirements: dict[str, list[str | None]] = {}
    # As the package was installed: a list of our own would lack what is added later.
    for line in requires("genre") or ():
        if match := _REQUIREMENT.match(line):
            requirements.setdefault(match["package"], []).append(match["extra"])
    return requirements


def _find_version(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    # Its metadata are enough: importing transformers alone would take seconds.
    try:
        return version(package)
    except PackageNotFoundError:
        return None
