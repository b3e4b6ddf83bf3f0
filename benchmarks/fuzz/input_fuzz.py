"""Feeds damaged and harmful files to every reader of this project, each in a process that may die of them.

>>> sorted(OUTCOMES)
['code run', 'crash', 'hang', 'memory', 'read', 'refused', 'wrong error', 'wrong read']
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

READ = "read"
REFUSED = "refused"
FINDINGS = ("wrong error", "wrong read", "crash", "hang", "memory", "code run")
"""What must never happen."""

OUTCOMES = (READ, REFUSED, *FINDINGS)
"""All that can become of an input."""

_ROOT = Path(__file__).resolve().parents[2]
_MODULE = "benchmarks.fuzz.fuzz_worker"


def measure_input_fuzz(inputs: int, seed: int) -> dict[str, Any]:
    """Reads damaged files of every format and counts what becomes of them.

    A valid file must be read. A damaged one is read, or refused by an error that names the file and a remedy.
    Everything else is a finding.

    Args:
        inputs: how many files; they follow from the seed and their index.
        seed: of all inputs.

    Returns:
        ``inputs``, ``seed``, ``seconds``; ``formats`` (counts of ``OUTCOMES``, and the longest ``seconds`` and largest
        ``memory_mib`` of an input, by format); ``findings`` (rows with ``index``, ``format``, ``reader``, ``damage``,
        ``outcome`` and ``detail``). :func:`make_input` writes the file of an index again.
    """
    from benchmarks.fuzz.fuzz_inputs import FuzzInputs

    begin_s = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        made = FuzzInputs(seed, inputs, Path(name))
        # Worked out here, as a process that dies cannot say what it was reading.
        targets = [made.target(index) for index in range(inputs)]
    formats: dict[str, Counter[str]] = {target.format: Counter() for target in targets}
    longest = dict.fromkeys(formats, 0.0)
    largest = dict.fromkeys(formats, 0.0)
    findings = []
    for row in _read_all(inputs, seed):
        target = targets[row["index"]]
        # A valid file that is refused would hide that nothing behind the refusal is tested.
        if row.get("damage") == "keep" and row["outcome"] == REFUSED:
            row |= {"outcome": "wrong error", "detail": "a valid file is refused"}
        formats[target.format][row["outcome"]] += 1
        longest[target.format] = max(longest[target.format], row.get("seconds", 0.0))
        largest[target.format] = max(largest[target.format], row.get("memory_mib", 0.0))
        if row["outcome"] in FINDINGS:
            findings.append({"format": target.format, "reader": target.reader, **row})
    return {
        "inputs": inputs,
        "seed": seed,
        "seconds": time.perf_counter() - begin_s,
        "formats": {
            name: {outcome: counts[outcome] for outcome in OUTCOMES}
            | {"seconds": longest[name], "memory_mib": largest[name]}
            for name, counts in formats.items()
        },
        "findings": findings,
    }


def make_input(inputs: int, seed: int, index: int, folder: Path) -> Path:
    """Writes one input of a run, with the files that its reader needs.

    Args:
        inputs: how many inputs the run had.
        seed: of the run.
        index: of the input.
        folder: that exists.

    Returns:
        The damaged file.
    """
    from benchmarks.fuzz.fuzz_inputs import FuzzInputs

    return FuzzInputs(seed, inputs, folder).write(index)[1]


def _read_all(inputs: int, seed: int) -> Iterator[dict[str, Any]]:
    """A row for every input; a new process goes on after one that died."""
    start = 0
    # One process reads as long as it lives: imports take longer than hundreds of inputs.
    while start < inputs:
        rows, died_at, status = _run_worker(seed, start, inputs)
        yield from rows
        if died_at is None:
            if status or len(rows) < inputs - start:
                raise RuntimeError(
                    f"the process of inputs ended with {status} before it read input {start + len(rows)}"
                )
            return
        outcome = "hang" if status == -signal.SIGALRM else "crash"
        yield {"index": died_at, "outcome": outcome, "detail": f"the process ended with {status}"}
        start = died_at + 1


def _run_worker(seed: int, start: int, inputs: int) -> tuple[list[dict[str, Any]], int | None, int]:
    """Rows of a process, the input that it died of, and its exit status."""
    done = subprocess.run(
        [sys.executable, "-m", _MODULE, str(seed), str(start), str(inputs), str(inputs)],
        cwd=_ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    # The last line may be cut off where the process died while it wrote.
    lines = [json.loads(line) for line in done.stdout.splitlines() if line.endswith("}")]
    rows = [line for line in lines if "outcome" in line]
    last = lines[-1] if lines else {}
    return rows, last.get("started"), done.returncode
