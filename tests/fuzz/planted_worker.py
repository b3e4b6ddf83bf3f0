"""A worker whose readers do what no reader may: the fuzzers must notice all of it."""

from __future__ import annotations

import os
import pickle
import sys
import time
from pathlib import Path

from benchmarks.fuzz import fuzz_inputs, fuzz_worker
from benchmarks.fuzz.fuzz_attacks import CANARY
from benchmarks.fuzz.fuzz_mutations import keep
from benchmarks.fuzz.fuzz_target import FuzzTarget, WrongReadError, give_samples
from genre_tasks.errors import InputError

SECONDS = 2


def _take_memory(path: Path) -> object:
    return b"x" * (128 << 20)


def _ask_for_too_much(path: Path) -> object:
    return bytearray(1 << 42)


def _unpickle(path: Path) -> object:
    return pickle.loads(b"cos\ngetcwd\n(tR.")


def _write_canary(path: Path) -> object:
    return (path.parent / CANARY).write_text("")


def _open_elsewhere(path: Path) -> object:
    return Path("/etc/passwd").read_bytes()


def _hang(path: Path) -> object:
    return time.sleep(60)


def _die(path: Path) -> object:
    os.abort()


def _fail(path: Path) -> object:
    raise KeyError("x")


def _say_nothing(path: Path) -> object:
    raise InputError("it is broken", remedy="Mend it.")


def _read_wrongly(path: Path) -> object:
    raise WrongReadError("two columns")


def _refuse(path: Path) -> object:
    raise InputError("it is broken", remedy="Mend it.", file=path)


READERS = {
    "reads": (bytes, "read"),
    "refuses": (_refuse, "refused"),
    "fails": (_fail, "wrong error"),
    "names no file": (_say_nothing, "wrong error"),
    "reads wrongly": (_read_wrongly, "wrong read"),
    "dies": (_die, "crash"),
    "hangs": (_hang, "hang"),
    "takes memory": (_take_memory, "memory"),
    "asks for too much": (_ask_for_too_much, "memory"),
    "unpickles": (_unpickle, "code run"),
    "runs code": (_write_canary, "code run"),
    "opens files elsewhere": (_open_elsewhere, "code run"),
}
"""What a reader does, and what it must be counted as."""


def plant_targets() -> tuple[FuzzTarget, ...]:
    """A target for each reader; its inputs are all the same, and are called damaged."""
    return tuple(
        FuzzTarget(name, name, "input.bin", give_samples(b"x"), _read_path if read is bytes else read, (damage,), 1, 64)
        for name, (read, _) in READERS.items()
    )


def damage(rng: object, data: bytes, others: object) -> bytes:
    return data + b"y"


def _read_path(path: Path) -> object:
    return path.read_bytes()


def warm_up_nothing(self: fuzz_inputs.FuzzInputs, start: int, stop: int) -> None:
    """Valid files would end the process before it begins."""


if __name__ == "__main__":
    assert keep(None, b"x", []) == b"x"  # type: ignore[arg-type]
    fuzz_inputs.list_targets = plant_targets
    fuzz_inputs.UNCHANGED_EVERY = 1 << 30
    fuzz_inputs.FuzzInputs.warm_up = warm_up_nothing  # type: ignore[method-assign]
    fuzz_worker.SECONDS = SECONDS
    fuzz_worker.main(sys.argv[1:])
