"""Hooks inside the processes of workers: a log of what is computed, and faults at named points.

A ``sitecustomize`` that the cluster writes imports this module in every process whose environment names the folder.
Nothing of the project is changed on disk. The log has a line for the start and the end of every computation.
A file in ``armed/`` is one fault: the first process that comes to its point takes the file and suffers the fault.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any

FOLDER_VARIABLE = "GENRE_FAULT_FOLDER"
COMPUTED = "computed.jsonl"
ARMED = "armed"
TAKEN = "taken"
_LIMIT_BYTES = 64 << 20
_HOLD_S = 600.0
_running: dict[str, str] = {}


def note(folder: Path, event: str, **values: object) -> None:
    """Appends a line; one write of a short line is atomic, also for many processes."""
    line = json.dumps({"time": time.clock_gettime(time.CLOCK_MONOTONIC), "event": event, "pid": os.getpid(), **values})
    handle = os.open(folder / COMPUTED, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(handle, (line + "\n").encode())
    finally:
        os.close(handle)


def take(folder: Path, point: str, stage: str = "") -> bool:
    """Whether a fault is armed for this point; it is taken by one process alone.

    Args:
        folder: of the faults.
        point: name of the point; a file is named ``POINT.NUMBER`` or ``POINT@STAGE.NUMBER``.
        stage: the stage that runs.
    """
    for armed in sorted((folder / ARMED).glob(f"{point}*")):
        name = armed.name.rpartition(".")[0]
        if name not in (point, f"{point}@{stage}"):
            continue
        # Renamed: the first of several processes wins.
        with suppress(OSError):
            armed.rename(folder / TAKEN / armed.name)
            note(folder, "fault", point=point, fault=armed.name, **_running)
            return True
    return False


def fail_to_allocate() -> None:
    """Runs out of memory: an allocation beyond a limit of the system on this process's address space."""
    import numpy

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + _LIMIT_BYTES, hard))
    try:
        # More than the process has altogether: memory that was freed and stays with it can never be enough.
        numpy.ones(used + 4 * _LIMIT_BYTES, dtype=numpy.uint8)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def suffer(folder: Path, stage: str) -> None:
    """Suffers what is armed for the start of a stage's computation."""
    if take(folder, "memory", stage):
        fail_to_allocate()
    if take(folder, "transient", stage):
        from genre_tasks.errors import TransientIOError

        raise TransientIOError("an armed fault", remedy="It is tried again.")


def hook_stage_runner(folder: Path, module: ModuleType) -> None:
    """Changes ``flows.pipeline.stage_runner``: computations are noted, and suffer what is armed."""
    compute: Callable[..., Any] = module._compute_artifact
    measure: Callable[[], AbstractContextManager[Any]] = module.measure_usage

    def compute_and_note(spec: Any, job: Any, inputs: Any, store: Any, address: Any, *more: Any) -> Any:
        about = {"key": address.key, "stage": spec.name, "log": job.log, "store": job.store}
        _running.clear()
        _running.update(about)
        note(folder, "start", **about)
        try:
            artifact = compute(spec, job, inputs, store, address, *more)
        except BaseException as error:
            note(folder, "failed", **about, why=f"{type(error).__name__}: {error}"[:300])
            raise
        note(folder, "done", **about)
        return artifact

    @contextmanager
    def measure_and_suffer() -> Iterator[Any]:
        with measure() as usage:
            suffer(folder, _running.get("stage", ""))
            yield usage

    module._compute_artifact = compute_and_note  # type: ignore[attr-defined]
    module.measure_usage = measure_and_suffer  # type: ignore[attr-defined]


def hook_flow_engine(folder: Path, module: ModuleType) -> None:
    """Changes ``prefect.flow_engine``: a run may be stopped before it sends its first heartbeat."""
    base = module.BaseFlowRunEngine
    emit: Callable[..., None] = base._emit_flow_run_heartbeat

    def hold_and_emit(self: Any, *args: Any, **kwargs: Any) -> None:
        if take(folder, "heartbeat"):
            # The test kills this process here; the time ends a run that was forgotten.
            time.sleep(_HOLD_S)
        emit(self, *args, **kwargs)

    base._emit_flow_run_heartbeat = hold_and_emit


_HOOKS = {"flows.pipeline.stage_runner": hook_stage_runner, "prefect.flow_engine": hook_flow_engine}


class HookFinder(importlib.abc.MetaPathFinder):
    """Finds the modules with hooks, and changes them once they are loaded."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname not in _HOOKS:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path)
        if spec is None or spec.loader is None:
            return spec
        load = spec.loader.exec_module

        def load_and_hook(module: ModuleType) -> None:
            load(module)
            _HOOKS[fullname](self.folder, module)

        spec.loader.exec_module = load_and_hook  # type: ignore[method-assign]
        return spec


def install(folder: Path) -> None:
    """Makes this process note what it computes, and suffer what is armed."""
    sys.meta_path.insert(0, HookFinder(folder))


if FOLDER_VARIABLE in os.environ:
    install(Path(os.environ[FOLDER_VARIABLE]))
