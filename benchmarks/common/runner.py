"""Runs a benchmark: cell by cell, each kept as soon as it is measured, so that a broken-off run goes on."""

from __future__ import annotations

import hashlib
import json
import re
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.common.bench import Bench, Cell, NotMeasuredError, Row
from benchmarks.common.claims import Result, write_json
from flows.machine.facts import commit, machine
from genre_tasks.errors import ArtifactCorruptError, ConfigError
from storage.code_digest import code_digest

CACHE = Path(".genre/bench")
QUICK_S = 20 * 60.0
"""A quick run leaves out what would not end by then."""


@dataclass(frozen=True)
class Plan:
    """A cell and where its row is kept; ``row`` is ``None`` until it was measured."""

    cell: Cell
    path: Path
    row: Row | None


def options_of(bench: Bench, settings: tuple[str, ...]) -> dict[str, str]:
    """The benchmark's options with ``NAME=VALUE`` settings applied. Raises ``ConfigError`` for an unknown name."""
    options = dict(bench.options)
    for setting in settings:
        name, equals, value = setting.partition("=")
        if not equals or name not in options:
            known = ", ".join(f"{k}={v}" for k, v in options.items()) or "none"
            raise ConfigError(f"bench {bench.name} has no option {setting!r}", remedy=f"Known: {known}.")
        options[name] = value
    return options


def plan(bench: Bench, options: Mapping[str, str], quick: bool, fresh: bool, cache: Path = CACHE) -> list[Plan]:
    """The cells, each with the row it has in the cache (none with ``fresh``)."""
    code, where = code_digest(bench.code[0], bench.code[1:]), machine()
    plans = []
    for cell in bench.cells(options, quick):
        text = json.dumps([bench.name, cell.name, dict(cell.parameters), code, where], sort_keys=True)
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        readable = re.sub(r"[^\w.-]+", "_", cell.name)
        path = cache / bench.name / f"{readable}-{key}.json"
        plans.append(Plan(cell, path, None if fresh else _kept(path)))
    return plans


def _kept(path: Path) -> Row | None:
    if not path.exists():
        return None
    try:
        row = json.loads(path.read_text(encoding="utf-8"))["row"]
    except (ValueError, KeyError, TypeError) as error:
        raise ArtifactCorruptError(
            f"a measured cell cannot be read: {error}", remedy="Delete the file, or use --fresh.", file=path
        ) from error
    return dict(row)


def measure(plans: list[Plan], say: Callable[[str], None], limit_s: float | None = None) -> dict[str, Row]:
    """Rows by cell: kept ones as they are, the others measured now and kept.

    A cell that cannot be measured here, or would not end within ``limit_s``, has the row ``{"not_measured": why}``,
    which is not kept.
    """
    rows: dict[str, Row] = {}
    began = time.monotonic()
    for p in plans:
        start = time.monotonic()
        if p.row is not None:
            rows[p.cell.name] = p.row
            say(f"{p.cell.name}: from the cache")
            continue
        try:
            if limit_s is not None and start - began + p.cell.seconds > limit_s:
                raise NotMeasuredError(f"left out: would not end within {limit_s / 60:.0f} minutes")
            rows[p.cell.name] = row = p.cell.measure()
        except NotMeasuredError as reason:
            rows[p.cell.name] = {"not_measured": str(reason)}
            say(f"{p.cell.name}: not measured: {reason}")
            continue
        seconds = time.monotonic() - start
        write_json(p.path, {"cell": p.cell.name, "parameters": dict(p.cell.parameters), "seconds": seconds, "row": row})
        say(f"{p.cell.name}: measured in {seconds:.1f} s")
    return rows


def result_of(bench: Bench, rows: Mapping[str, Row]) -> Result:
    """Rows and claims with machine and commit, checked against the schema."""
    named = [{"cell": name, **row} for name, row in rows.items()]
    return Result(machine=machine(), commit=commit(), rows=named, claims=list(bench.claims(rows)))


def run_bench(
    bench: Bench, json_file: Path, options: Mapping[str, str], quick: bool, fresh: bool, cache: Path = CACHE
) -> Result:
    """Measures what is not in the cache, writes the file, prints the table to stdout and the claims to stderr."""
    rows = measure(plan(bench, options, quick, fresh, cache), _say, QUICK_S if quick else None)
    result = result_of(bench, rows)
    write_json(json_file, result.model_dump(mode="json"))
    for line in bench.table(rows):
        sys.stdout.write(line + "\n")
    for c in result.claims:
        word = "holds" if c.holds else "FAILS"
        measured = "not measured" if c.measured is None else f"{c.measured:12.4f}"
        _say(f"{word}  {c.id:<28} {measured} {c.op} {c.target} {c.unit}  {c.data}")
    return result


def dry_run(plans: list[Plan]) -> list[dict[str, Any]]:
    """A line per cell: predicted seconds, or that it is in the cache."""
    return [
        {"cell": p.cell.name, "cached": p.row is not None, "seconds": 0.0 if p.row is not None else p.cell.seconds}
        for p in plans
    ]


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
