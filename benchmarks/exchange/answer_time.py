"""How soon ``genre`` answers: its help, and what a store with a run of many chunks holds."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.command import COMMAND
from benchmarks.common.timing import Quartiles
from flows.machine.facts import CHECKOUT
from flows.pipeline.definition import PIPELINE, StageSpec
from storage.address import Address
from storage.codecs import get_codec
from storage.manifest import FileEntry, Manifest, payload_digest
from storage.manifest_writer import list_payload, write_manifest

CHUNKS = 100
MOST_HELP_S = 1.0
MOST_SHOW_S = 2.0
_RUN = "a0" * 6
_METRICS = tuple(f"{group}/{m}" for group in ("interpolation", "shift_3m") for m in ("psnr", "ssim", "kernel", "n"))


def measure_answer_time(rounds: int, chunks: int = CHUNKS) -> Row:
    """Times commands that only read, as processes of their own, on a store with one run of tiny artifacts.

    Args:
        rounds: how often.
        chunks: of the run; each has an artifact of every stage.

    Returns:
        Seconds by command: ``help``, ``runs``, ``run``, ``artifact``, ``stages`` and ``diff``.

    Raises:
        NotMeasuredError: a command fails.
    """
    seconds: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "store"
        key = write_tiny_run(store, chunks)
        at = ("--store", str(store))
        commands: dict[str, tuple[str, ...]] = {
            "help": ("--help",),
            "runs": ("show", *at),
            "run": ("show", _RUN, *at),
            "artifact": ("show", key[:12], *at),
            "stages": ("show", "stages", *at),
            "diff": ("diff", _RUN, _RUN, *at),
        }
        # In turns, so that drift of the machine meets all of them alike; the first round warms the files' cache.
        for k in range(rounds + 1):
            for name, words in commands.items():
                taken = _time_command(folder, words)
                if k:
                    seconds.setdefault(name, []).append(taken)
    return {"chunks": chunks, "seconds": {name: Quartiles.from_values(s).as_row() for name, s in seconds.items()}}


def write_tiny_run(store: Path, chunks: int) -> str:
    """Writes a store with one finished run whose artifacts are a few numbers each.

    Args:
        store: a folder that does not exist yet.
        chunks: of the run.

    Returns:
        The key of one evaluation in the middle of the store.
    """
    keys = {
        (c, spec.name): hashlib.sha256(f"{c} {spec.name}".encode()).hexdigest()
        for c in range(chunks)
        for spec in PIPELINE
    }
    for (chunk, stage), key in keys.items():
        _write_artifact(store, Address("synthetic", "street-seed=1", chunk, stage, key))
    record = {
        "status": "done",
        "run": _RUN,
        "log": "synthetic:street?seed=1",
        "preset": "demo",
        "store": str(store),
        "report": "report.html",
        "config": {},
        "differs": {},
        "chunks": [
            {"chunk": c, "warnings": [], "stages": [_stage_record(spec, keys[c, spec.name]) for spec in PIPELINE]}
            for c in range(chunks)
        ],
        "left_out": [],
    }
    folder = store / "runs" / _RUN
    folder.mkdir(parents=True)
    (folder / "run.json").write_text(json.dumps(record), encoding="utf-8")
    return keys[chunks // 2, "evaluate/gnet"]


def answer_time_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that help and the tables of a large store come at once.

    Args:
        rows: see :func:`measure_answer_time`.
    """
    for name, most_s, note in (
        ("help", MOST_HELP_S, "`genre --help`, the whole command"),
        ("run", MOST_SHOW_S, f"`genre show RUN` of {CHUNKS} chunks, the whole command"),
        ("artifact", MOST_SHOW_S, f"`genre show KEY` in a store of {CHUNKS} chunks, the whole command"),
    ):
        found: list[Mapping[str, Any]] = [row["seconds"][name] for row in rows]
        if not found:
            yield claim(f"exchange.answer_{name}", None, "<=", most_s, "s", note)
            continue
        slowest = max(found, key=lambda s: float(s["median"]))
        spread = (slowest["low"], slowest["high"])
        yield claim(f"exchange.answer_{name}", slowest["median"], "<=", most_s, "s", note, int(slowest["n"]), spread)


def answer_time_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each command.

    Args:
        rows: see :func:`measure_answer_time`.
    """
    yield "| command | median, s | quartiles, s |"
    yield "|---|---|---|"
    for row in rows:
        for name, m in row["seconds"].items():
            yield f"| {name}, {row['chunks']} chunks | {m['median']:.2f} | {m['low']:.2f}–{m['high']:.2f} |"


def _write_artifact(store: Path, address: Address) -> None:
    from genre_tasks.metrics.results import Evaluation, Metric

    folder = store / address.relative_path
    folder.mkdir(parents=True)
    # All of one kind, as what is in them does not matter here: a command reads one artifact at most.
    get_codec("evaluation").write(folder, Evaluation(address.stage, (Metric("interpolation/psnr", 24.0, 45),)))

    def make_manifest(files: tuple[FileEntry, ...]) -> Manifest:
        return Manifest(
            kind="evaluation",
            files=files,
            payload_digest=payload_digest(files),
            inputs={},
            configuration={},
            code_digest="",
            weights_digest=None,
            seconds=1.0,
            peak_mib=1.0,
            created_at="2026-01-01T00:00:00+00:00",
            environment={},
            measurements={},
            warnings=(),
            **asdict(address),
        )

    write_manifest(folder, make_manifest(list_payload(folder)))


def _stage_record(spec: StageSpec, key: str) -> dict[str, Any]:
    is_scored = spec.name in ("initial", "gnet", "fnet", "enet")
    metrics = dict.fromkeys(_METRICS, 24.0) if is_scored else {}
    return {"stage": spec.name, "key": key, "cached": False, "seconds": 1.0, "peak_mib": 1.0, "metrics": metrics}


def _time_command(home: str, words: Sequence[str]) -> float:
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), "XDG_STATE_HOME": home}
    start = time.perf_counter()
    done = subprocess.run([*COMMAND, *words], env=environment, capture_output=True, text=True, check=False)
    taken = time.perf_counter() - start
    if done.returncode:
        raise NotMeasuredError(f"genre {' '.join(words)} ended with {done.returncode}: {done.stderr[-500:]}")
    return taken
