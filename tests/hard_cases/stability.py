"""``docs/reference/stability.md``: measured rows of the hard cases, and the tests of those without a measured error.

The words, bounds and tests come from the tables beside this file; only the measured numbers come from a run.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from tests.hard_cases.case_list import LISTED, SECTIONS

BACKENDS = ("reference", "cpu")

HEAD = """# Hard cases: what stays stable, by how much, and where it is tested

This page is written by the command below. A test holds that rows, bounds and named tests are those of the suite.
To add a case, add a line to a table in `tests/hard_cases`: `render_cases.py`, `case_measurements.py` or `case_list.py`.

```text
pytest -m "slow or not slow" tests/hard_cases/test_geometry.py tests/hard_cases/test_compositing.py
  tests/hard_cases/test_effects.py --stability-report docs/reference/stability.md
```

Errors are against the float64 reference of the same input, the largest found.

| quantity | meaning |
|---|---|
| image | largest absolute error of colour, alpha, and depth as a fraction of the farthest |
| gradient | relative L2 error of the worst of the five attributes |
| whole gradient | the same, with the pixels that are left out otherwise |

Pixels where rounding may decide are left out: alpha near 1/255 or the clamp, transmittance near the stop, and depths
too near to be told apart (`tests/render/oracles.py`). `reference` is the same code in float32.
`cuda` (gsplat) has no column: its images are held to 0.02 where there is a GPU, and no numbers have been taken.
Tests that are slow or inject faults are part of `make test-all`, the others of `make test`.
"""


@dataclass(frozen=True)
class Row:
    """A number that a test measures on each backend, and what it must not exceed."""

    number: int
    words: str
    quantity: str
    bound: float
    backends: tuple[str, ...] = BACKENDS


Measurements = Mapping[tuple[int, str, str, str], str]  # number, words, quantity, backend → two digits


def key(row: Row, backend: str) -> tuple[int, str, str, str]:
    """By what a measurement is filed."""
    return row.number, row.words, row.quantity, backend


def document(rows: tuple[Row, ...], measured: Measurements) -> str:
    """The whole document; rows keep the order of their tables within a number."""
    parts = [HEAD]
    for title, numbers in SECTIONS.items():
        parts.append(f"\n## {title}\n")
        if mine := sorted((r for r in rows if r.number in numbers), key=lambda r: r.number):
            parts.append("\n| # | case | quantity | bound | " + " | ".join(BACKENDS) + " |\n")
            parts.append("|---" * (4 + len(BACKENDS)) + "|\n")
            parts += [_line(row, measured) for row in mine]
        if listed := [n for n in numbers if n in LISTED]:
            parts += ["\n| # | case | test |\n", "|---" * 3 + "|\n"]
            for n in listed:
                words, tests = LISTED[n]
                named = tests if isinstance(tests, str) else ", ".join(f"`{t}`" for t in tests)
                parts.append(f"| {n} | {words} | {named} |\n")
    return "".join(parts)


def _line(row: Row, measured: Measurements) -> str:
    cells = [measured.get(key(row, b), "–") for b in BACKENDS]
    return f"| {row.number} | {row.words} | {row.quantity} | {row.bound:.1e} | " + " | ".join(cells) + " |\n"


def parsed(text: str) -> dict[tuple[int, str, str, str], str]:
    """The measurements in a document."""
    found = {}
    for line in text.splitlines():
        cells = [c.strip() for c in line.strip("|").split("|")]
        if re.match(r"\| \d+ \|", line) and len(cells) == 4 + len(BACKENDS):
            number, words, quantity, _, *numbers = cells
            for backend, number_text in zip(BACKENDS, numbers, strict=True):
                if number_text != "–":
                    found[int(number), words, quantity, backend] = number_text
    return found
