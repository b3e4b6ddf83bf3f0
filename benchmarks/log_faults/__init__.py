"""At which strength a fault of a log is found, and whether sound logs are left in peace.

genre bench log_faults --json docs/results/data/log_faults.json [--set seeds=1001] [--set sound_seeds=0-99]

Faults are put into streets, the real chunk, and a drive of KITTI in the PandaSet layout. What is recorded are the words
of the findings.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from benchmarks.common.bench import (
    TINY_STREET_PARAMETERS,
    Bench,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    measured_rows,
    split_option,
)
from benchmarks.common.claims import Claim, claim
from benchmarks.log_faults.faults import FAULTS
from benchmarks.log_faults.measures import ChunkOfLog, measure_fault, measure_sound_log

_SOUND_S = 8.0
_FAULT_S = 20.0
_STREET = "frames=8&samples=1"
_MAX_SECONDS = 2.0


class LogFaultsBench:
    """A cell for each sound log, and one for each log and fault."""

    name = "log_faults"
    options: Mapping[str, str] = {
        "seeds": "1001",
        "sound_seeds": "0-99",
        "street": f"{_STREET}&cameras=2",
        "sound_street": f"{_STREET}&cameras=2",
        "pandaset": "../shared/data/pandaset/002",
        "real_chunk": "1",
        "kitti": "../shared/data/kitti/2011_09_26/2011_09_26_drive_0009_sync",
    }
    code: tuple[str, ...] = (
        "benchmarks.log_faults.measures",
        "benchmarks.log_faults.faults",
        "genre_tasks.log_checks.plausibility",
        "genre_tasks.logs.kitti.reader",
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {
            "seeds": "900",
            "street": TINY_STREET_PARAMETERS.removeprefix("&"),
            "sound_seeds": "",
            "pandaset": "",
            "kitti": "",
        },
        "seed=900 path jumps",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the sound logs, then each fault of each log; ``quick`` takes the first ten sound streets."""
        sound_seeds = list_seeds(options["sound_seeds"])[: 10 if quick else None]
        sound = [ChunkOfLog.of_street(seed, options["sound_street"]) for seed in sound_seeds]
        faulty = [ChunkOfLog.of_street(seed, options["street"]) for seed in split_option(options["seeds"])]
        real = []
        if options["pandaset"]:
            sound += [ChunkOfLog(f"pandaset:{options['pandaset']}", chunk) for chunk in (0, 1)]
            real.append(ChunkOfLog(f"pandaset:{options['pandaset']}", int(options["real_chunk"])))
        if options["kitti"]:
            kitti = ChunkOfLog(f"kitti:{options['kitti']}", 0)
            sound.append(kitti)
            real.append(kitti)
        # Names are short: what streets look like, and where folders lie, is in the URI alone.
        cells = [
            Cell(f"sound {chunk.name}", _SOUND_S, partial(measure_sound_log, chunk), {"log": chunk.uri})
            for chunk in sound
        ]
        for chunk in [*faulty, *real]:
            for fault in FAULTS:
                seconds = _FAULT_S * len(fault.strengths)
                parameters = {"log": chunk.uri, "strengths": list(fault.strengths)}
                measure = partial(measure_fault, chunk, fault)
                cells.append(Cell(f"{chunk.name} {fault.name}", seconds, measure, parameters))
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Claims that sound logs give no finding, that strong faults give one, and that it takes little time."""
        measured = measured_rows(rows)
        sound = [row for row in measured if row["fault"] == "none"]
        for name, is_street in (("streets", True), ("real", False)):
            found = [row for row in sound if row["log"].startswith("synthetic:") == is_street]
            alarms = float(sum(len(row["words"]) for row in found)) if found else None
            note = f"findings on {len(found)} sound chunks"
            yield claim(f"log_faults.false_alarms_{name}", alarms, "<=", 0, "findings", note, len(found))
        faulty = [row for row in measured if row["fault"] != "none"]
        strongest = [float(bool(row["found"][-1])) for row in faulty]
        fraction = sum(strongest) / len(strongest) if strongest else None
        note = "each fault at the last strength of its list, on each log"
        yield claim("log_faults.found_strongest", fraction, ">=", 0.95, "fraction", note, len(strongest))
        seconds = max((row["cpu_seconds"] for row in sound if row["log"].startswith("pandaset:")), default=None)
        note = "all checks of a chunk of twenty frames with six cameras, the slower of two"
        yield claim("log_faults.seconds", seconds, "<=", _MAX_SECONDS, "s", note)

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives a line for each log and fault: the strengths that are found and those that are not."""
        yield "| log | fault | not found at | found at | as |"
        yield "|---|---|---|---|---|"
        for row in measured_rows(rows):
            if row["fault"] == "none":
                if row["words"]:
                    yield f"| {row['name']} | none | | | **{', '.join(row['words'])}** |"
                continue
            yield f"| {row['name']} | {row['fault']} | {' | '.join(format_strengths(row))} |"
        yield from list_not_measured(rows)


def format_strengths(row: Row) -> tuple[str, str, str]:
    """Formats where a fault is found.

    Args:
        row: of a log and a fault.

    Returns:
        The strengths that are not found, those that are, and the most frequent words.

    >>> format_strengths({"unit": "°", "strengths": [1, 5], "found": [[], ["turned_camera"]]})
    ('1 °', '5 °', '`turned_camera`')
    """
    pairs = list(zip(row["strengths"], row["found"], strict=True))
    words = [word for _, found in pairs for word in found]
    # Most frequent first; of equally frequent ones the first that was found.
    ranked = sorted(dict.fromkeys(words), key=words.count, reverse=True)[:3]
    missed = ", ".join(f"{strength:g}" for strength, found in pairs if not found)
    hit = ", ".join(f"{strength:g}" for strength, found in pairs if found)
    unit = row["unit"]
    if not unit:
        missed = "always" if missed else ""
        hit = "always" if hit else ""
    texts = [f"{text} {unit}".strip() if text else "" for text in (missed, hit)]
    return texts[0], texts[1], ", ".join(f"`{word}`" for word in ranked)


def list_seeds(text: str) -> list[str]:
    """Lists the seeds of an option: numbers with commas, or a range.

    >>> list_seeds("0-3"), list_seeds("7,9"), list_seeds("")
    (['0', '1', '2', '3'], ['7', '9'], [])
    """
    seeds = []
    for part in split_option(text):
        first, _, last = part.partition("-")
        seeds += [str(seed) for seed in range(int(first), int(last or first) + 1)]
    return seeds


BENCH: Bench = LogFaultsBench()
