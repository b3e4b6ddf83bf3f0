"""How long a user waits before anything is computed: a run that finds everything, and the start of Prefect's API.

genre bench start_up --json docs/results/data/start_up.json
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.bench import TINY_SETTINGS, TINY_STREET, Bench, Cell, Row, SmallestForm, settings_from_options
from benchmarks.common.cell_parameters import describe_preset
from benchmarks.common.claims import Claim, claim
from benchmarks.common.command import run_genre
from benchmarks.common.lazy_modules import CODEC_MODULES, STAGE_MODULES
from benchmarks.common.timing import Quartiles
from flows.machine.facts import CHECKOUT

_PRESET = "demo"
_START = """
import time
from flows.cli.main import prepare_environment
prepare_environment(debug=False)
from flows.prefect_api.connection import connect_to_prefect
import prefect.settings
began = time.perf_counter()
with connect_to_prefect():
    print(time.perf_counter() - began)
"""
_CLAIMS = (
    ("cached_run_s", "cached_run", 5.0, "a run whose stages are all in the store, the whole command"),
    ("api_s", "api", 5.0, "Prefect's API from its start until it answers"),
    ("first_api_s", "first_api", 10.0, "the same, where its database has to be made"),
)
"""Claim, its cell, most seconds, data."""


class StartUp:
    """Seconds of whole commands, timed from outside."""

    name = "start_up"
    options: Mapping[str, str] = {"seed": "1000", "settings": ""}
    code: tuple[str, ...] = (
        "benchmarks.start_up",
        "flows.prefect_api.connection",
        "flows.cli.run",
        "storage.local",
        *CODEC_MODULES,
        *STAGE_MODULES,
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm({"seed": TINY_STREET, "settings": TINY_SETTINGS}, only="cached_run")

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the cached run and the two starts of Prefect's API.

        Args:
            options: ``seed`` of the street and ``settings`` over the preset ``demo``, for the cached run.
            quick: fewer rounds.

        Returns:
            Three cells.
        """
        rounds = 1 if quick else 9
        settings = settings_from_options(options)
        run = partial(measure_cached_run, options["seed"], settings)
        street = {"seed": options["seed"], **describe_preset(_PRESET, settings)}
        measures: tuple[tuple[str, Callable[[int], Row], float, dict[str, Any]], ...] = (
            ("cached_run", run, 60.0, street),
            ("api", partial(measure_api, False), 5.0, {}),
            ("first_api", partial(measure_api, True), 8.0, {}),
        )
        return [
            Cell(name, first_s + 5.0 * rounds, partial(measure, rounds), {"rounds": rounds, **parameters})
            for name, measure, first_s, parameters in measures
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes one claim of each cell.

        Args:
            rows: by cell.

        Yields:
            Claim: each once.
        """
        for name, cell, most_s, data in _CLAIMS:
            m = rows[cell].get("seconds")
            if m is None:
                yield claim(f"start_up.{name}", None, "<=", most_s, "s", data)
            else:
                yield claim(f"start_up.{name}", m["median"], "<=", most_s, "s", data, m["n"], (m["low"], m["high"]))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Makes the table that the command prints."""
        yield "| what | median, s | quartiles, s |"
        yield "|---|---|---|"
        for name, row in rows.items():
            if "seconds" in row:
                m = row["seconds"]
                yield f"| {name} | {m['median']:.2f} | {m['low']:.2f}–{m['high']:.2f} |"


def measure_cached_run(seed: str, settings: tuple[str, ...], rounds: int) -> Row:
    """Times ``genre run`` on a store that has every stage.

    Args:
        seed: of the street, with further parameters of its URI if need be.
        settings: over the preset ``demo``.
        rounds: how often.

    Returns:
        ``seconds`` of the command.
    """
    options = ["--preset", _PRESET]
    for setting in settings:
        options += ["--set", setting]
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder) / "prefect"
        run = partial(run_genre, f"synthetic:street?seed={seed}", home, *options, "--store", f"{folder}/store")
        run()
        if rounds > 1:
            # Once more for the operating system's cache of files.
            run()
        return {"seconds": Quartiles.from_values([_time(run) for _ in range(rounds)]).as_row()}


def measure_api(first: bool, rounds: int) -> Row:
    """Times the start of Prefect's API in a process that has imported Prefect's client.

    Args:
        first: whether each start makes a new database.
        rounds: how often.

    Returns:
        ``seconds`` until it answers.
    """
    with tempfile.TemporaryDirectory() as folder:
        homes = [Path(folder) / (str(k) if first else "prefect") for k in range(rounds + 1)]
        # The first is not counted: it may read files that the later ones find in memory, or make the database.
        seconds = [_start_api(home) for home in homes][1:]
    return {"seconds": Quartiles.from_values(seconds).as_row()}


def _start_api(home: Path) -> float:
    environment = {"PYTHONPATH": str(CHECKOUT), "PREFECT_HOME": str(home), "PATH": ""}
    done = subprocess.run([sys.executable, "-c", _START], env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def _time(action: Callable[[], object]) -> float:
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


BENCH: Bench = StartUp()
