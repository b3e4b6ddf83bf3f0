"""The process that reads damaged files: it reports every input, so that its death or silence says which one it was.

python -m benchmarks.fuzz.fuzz_worker SEED START STOP COUNT writes a line of JSON before and after each input.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.fuzz.fuzz_attacks import CANARY
from benchmarks.fuzz.fuzz_inputs import FuzzInputs
from benchmarks.fuzz.fuzz_target import FuzzTarget, WrongReadError

SECONDS = 30
"""An input that takes longer hangs."""

ADDRESS_SPACE_MIB = 3072
"""So much more address space than before it the process may take while it reads an input."""

_FORBIDDEN_EVENTS = frozenset(
    {"os.system", "os.exec", "os.posix_spawn", "os.fork", "os.spawn", "subprocess.Popen", "pickle.find_class"}
    | {"socket.connect", "socket.getaddrinfo", "socket.bind", "urllib.Request", "webbrowser.open", "os.remove"}
    | {"shutil.rmtree", "ctypes.dlopen"}
)
_ROOT = str(Path(__file__).resolve().parents[2])


class EventWatch:
    """Records what Python's audit hooks report while an input is read: commands, connections, files elsewhere.

    Args:
        folder: files in it may be opened.
    """

    def __init__(self, folder: Path) -> None:
        self.events: list[str] = []
        self.is_on = False
        self.allowed: frozenset[str] = frozenset()
        self._folder = str(folder)
        sys.addaudithook(self._record)

    def _record(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self.is_on:
            return
        if event in _FORBIDDEN_EVENTS and event not in self.allowed:
            if event not in ("os.remove", "shutil.rmtree") or not self._is_inside(arguments[0]):
                self.events.append(f"{event} {str(arguments)[:100]}")
        elif event == "open" and isinstance(arguments[0], str | bytes) and not self._is_inside(arguments[0]):
            self.events.append(f"open {os.fsdecode(arguments[0])[:100]}")

    def _is_inside(self, path: Any) -> bool:
        if not isinstance(path, str | bytes | os.PathLike):
            return True
        # Not resolved: a link of the system would lead elsewhere.
        text = os.path.normpath(Path.cwd() / os.fsdecode(path))
        # Modules and presets that are read late are no files of an input.
        return text.startswith((self._folder, sys.prefix, sys.base_prefix, _ROOT, "/proc/", "/dev/"))


def main(arguments: list[str]) -> None:
    """Reads the inputs of a range of indices.

    Args:
        arguments: seed, first index, index after the last one, and how many inputs the whole run has.
    """
    seed, start, stop, count = (int(argument) for argument in arguments)
    # Threads of libraries would survive in no child, and their memory would count to an input.
    import torch

    torch.set_num_threads(1)
    report = os.fdopen(os.dup(1), "w", buffering=1)
    # What decoders print must not mix with the reports.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    with tempfile.TemporaryDirectory(prefix="genre-fuzz-") as name:
        folder = Path(name)
        inputs = FuzzInputs(seed, count, folder)
        inputs.warm_up(start, stop)
        os.environ["TMPDIR"] = name
        tempfile.tempdir = name
        code_folder = Path.cwd()
        watch = EventWatch(folder)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for index in range(start, stop):
            target, path, damage = inputs.write(index)
            _report(report, {"started": index})
            os.chdir(folder)
            _limit_address_space()
            row = _observe(target, path, watch)
            canaries = list(folder.rglob(CANARY))
            os.chdir(code_folder)
            if canaries:
                row |= {"outcome": "code run", "detail": "the canary was written"}
                canaries[0].unlink()
            _report(report, {"index": index, "damage": damage, **row})


def _limit_address_space() -> None:
    # Before every input: allocators keep address space that they do not use, and thousands of inputs add up.
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (ADDRESS_SPACE_MIB << 20), resource.RLIM_INFINITY))


def _report(stream: Any, row: dict[str, Any]) -> None:
    stream.write(json.dumps(row) + "\n")


def _observe(target: FuzzTarget, path: Path, watch: EventWatch) -> dict[str, Any]:
    watch.events.clear()
    watch.allowed = frozenset({"subprocess.Popen", "os.posix_spawn", "os.fork"} if target.starts_process else ())
    before_mib = _reset_peak()
    begin_s = time.perf_counter()
    # Its default action ends the process, also where a library of C hangs.
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(SECONDS)
    watch.is_on = True
    row = _read(target.read, path)
    watch.is_on = False
    signal.alarm(0)
    row["seconds"] = round(time.perf_counter() - begin_s, 4)
    row["memory_mib"] = round(_peak_mib() - before_mib, 1)
    if watch.events:
        return row | {"outcome": "code run", "detail": watch.events[0]}
    if row["memory_mib"] > target.memory_mib:
        return row | {"outcome": "memory", "detail": f"more than {target.memory_mib} MiB; {row.get('detail', '')}"}
    return row


def _read(read: Callable[[Path], object], path: Path) -> dict[str, Any]:
    from genre_tasks.errors import GenreError

    try:
        read(path)
        return {"outcome": "read"}
    except GenreError as error:
        if error.problem.strip() and error.remedy.strip() and _names_input(error, path):
            return {"outcome": "refused", "detail": type(error).__name__}
        return {"outcome": "wrong error", "detail": f"names no file or remedy: {type(error).__name__}: {error}"[:300]}
    except WrongReadError as error:
        return {"outcome": "wrong read", "detail": str(error)}
    except MemoryError as error:
        return {"outcome": "memory", "detail": f"MemoryError {_locate(error)}"}
    except Exception as error:
        return {"outcome": "wrong error", "detail": f"{type(error).__name__} {_locate(error)}: {error}"[:300]}


def _names_input(error: Exception, path: Path) -> bool:
    # Images come as bytes; whoever read them knows camera and frame.
    is_image = path.suffix in (".jpg", ".png")
    return is_image or path.stem in str(error) or str(path.parent) in str(error)


def _locate(error: BaseException) -> str:
    traceback = error.__traceback__
    where = ""
    while traceback is not None:
        name = Path(traceback.tb_frame.f_code.co_filename)
        if any(part in name.parts for part in ("genre_tasks", "storage", "flows")):
            where = f"{name.name}:{traceback.tb_lineno}"
        traceback = traceback.tb_next
    return where


def _reset_peak() -> float:
    """Starts a new peak of the process's memory; what it takes now, in MiB."""
    Path("/proc/self/clear_refs").write_text("5")
    return _status_mib("VmRSS")


def _peak_mib() -> float:
    return _status_mib("VmHWM")


def _status_mib(name: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) / 1024
    raise OSError(f"the system states no {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
