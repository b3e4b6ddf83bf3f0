"""What a benchmark is: cells that are measured one by one, and the claims and the table made of their rows."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from benchmarks.common.claims import Claim

Row = dict[str, Any]
"""What a cell measured, as JSON values; ``not_measured`` alone where it says why nothing was."""

TINY_STREET_PARAMETERS = "&width=64&height=36&samples=1&frames=8&cameras=1&lidar_beams=32&lidar_azimuths=300"
"""What a seed of a street is followed by in its URI for eight small frames of one camera."""

TINY_STREET = f"900{TINY_STREET_PARAMETERS}"
"""A seed with further parameters of the street's URI: eight small frames of one camera, read within a second."""

TINY_SETTINGS = (
    "ingest.width_px=64 ingest.height_px=36 initial.max_points=600 initial.distant_count=100 gnet.iterations=3 "
    "gnet.snapshots=0 enet.iterations=2 enet.snapshots=0 novel_views.lidar_max_points=600 novel_views.shifts_m=[3.0] "
    "evaluate.every=8 evaluate.bootstrap=5"
)
"""Value of an option ``settings`` under which a tiny street goes through every stage within seconds."""


class NotMeasuredError(Exception):
    """Raised by a cell that this machine cannot measure; the message says why, and becomes its row."""


@dataclass(frozen=True)
class Cell:
    """The smallest thing that is measured, cached and resumed.

    Attributes:
        name: unique within the benchmark.
        seconds: predicted.
        measure: measures the cell; may raise ``NotMeasuredError``.
        parameters: JSON values that say what is measured, as far as the name and the code do not.
    """

    name: str
    seconds: float
    measure: Callable[[], Row]
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SmallestForm:
    """The shortest run of a benchmark that still measures a real cell: it shows that the benchmark works end to end.

    Attributes:
        options: values of ``--set`` that make cells small.
        only: part of the name of the cell that is measured, for ``--only``.
    """

    options: Mapping[str, str]
    only: str

    def arguments(self) -> list[str]:
        """Gives the arguments of ``genre bench NAME`` that run this form.

        >>> SmallestForm({"seeds": "900"}, "seed=900").arguments()
        ['--quick', '--only', 'seed=900', '--set', 'seeds=900']
        """
        arguments = ["--quick", "--only", self.only]
        for name, value in self.options.items():
            arguments += ["--set", f"{name}={value}"]
        return arguments


class Bench(Protocol):
    """One set of claims.

    Attributes:
        name: as in ``genre bench NAME``.
        options: what ``--set`` may change, with defaults.
        code: names of modules; a cell's cached row is valid as long as they, and what they import of the benchmarks and
            of ``genre_tasks``, stay the same. What only flows import has to be named.
        smallest: options of the shortest run.
    """

    name: str
    options: Mapping[str, str]
    code: tuple[str, ...]
    smallest: SmallestForm

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists what is measured, in order; ``quick`` takes fewer runs."""
        ...

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims of the rows by cell; a row with ``not_measured`` has nothing else to read."""
        ...

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives lines of Markdown."""
        ...


def split_option(text: str) -> list[str]:
    """Splits the value of an option at its commas; empty parts are left out.

    >>> split_option("1001,1002")
    ['1001', '1002']
    >>> split_option("")
    []
    """
    return [part for part in text.split(",") if part]


def settings_from_options(options: Mapping[str, str]) -> tuple[str, ...]:
    """Gives the configuration that the option ``settings`` puts over the preset.

    Args:
        options: ``settings``, with spaces between ``section.key=value``.

    Returns:
        The settings.

    >>> settings_from_options({"settings": "gnet.iterations=3 enet.iterations=2"})
    ('gnet.iterations=3', 'enet.iterations=2')
    """
    # Spaces and not commas, because values such as lists hold commas.
    return tuple(options["settings"].split())


def logs_from_options(options: Mapping[str, str]) -> list[tuple[str, int]]:
    """Lists the logs that the options name.

    Args:
        options: ``seeds`` of synthetic streets, each with further URI parameters if need be; ``pandaset``, the folder
            of a real sequence, or empty to leave it out; ``real_chunk``, its chunk, where a benchmark has the option.

    Returns:
        URI and chunk of each: chunk 0 of the streets, and of the real sequence chunk 1, which nothing was tuned on.

    >>> logs_from_options({"seeds": "1001", "pandaset": "data/002"})
    [('synthetic:street?seed=1001', 0), ('pandaset:data/002', 1)]
    """
    logs = [(f"synthetic:street?seed={seed}", 0) for seed in split_option(options["seeds"])]
    # Real data is not shipped, so a benchmark has to run without it.
    if options["pandaset"]:
        logs.append((f"pandaset:{options['pandaset']}", int(options.get("real_chunk", "1"))))
    return logs


def measured_rows(rows: Mapping[str, Row]) -> list[Row]:
    """Gives the rows of cells that were measured."""
    return [row for row in rows.values() if "not_measured" not in row]


def list_not_measured(rows: Mapping[str, Row]) -> Iterator[str]:
    """Gives a Markdown paragraph for each cell that was not measured.

    Args:
        rows: by cell.

    Returns:
        Lines that end a benchmark's table.

    >>> list(list_not_measured({"cuda": {"not_measured": "there is no GPU"}}))
    ['\\ncuda: not measured: there is no GPU']
    """
    for name, row in rows.items():
        if "not_measured" in row:
            yield f"\n{name}: not measured: {row['not_measured']}"
