"""Past one machine: workers, orchestration, the store on S3, a simulated cluster, and files that do harm.

genre bench scale --json docs/results/data/scale.json [--only cached] [--set settings="gnet.iterations=3"]

The cells start real services: PostgreSQL, a Prefect server, workers, an S3 server. They want a quiet machine.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET_PARAMETERS,
    Bench,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    settings_from_options,
    split_option,
)
from benchmarks.common.claims import Claim, claim
from benchmarks.common.lazy_modules import CODEC_MODULES, FORMAT_MODULES, STAGE_MODULES
from benchmarks.fuzz.input_fuzz import FINDINGS, measure_input_fuzz
from benchmarks.scale.cluster import measure_cluster
from benchmarks.scale.datasets import (
    measure_cached_logs,
    measure_object_store,
    measure_orchestration,
    measure_throughput,
)


class Scale:
    """Datasets on workers, the store on S3, and the fuzzers."""

    name = "scale"
    options: Mapping[str, str] = {
        "seeds": ",".join(str(seed) for seed in range(900, 916)),
        "street": "&cameras=1&frames=8",
        "preset": "small",
        "throughput_preset": "demo",
        "settings": "",
        "cached_street": TINY_STREET_PARAMETERS,
        "cluster": "1000x100",
        "seconds_scale": "0.4",
        "inputs": "10000",
    }
    code: tuple[str, ...] = (
        "benchmarks.scale",
        "benchmarks.fuzz.fuzz_worker",
        "flows.dataset.flow",
        "flows.reconstruction.flow",
        "flows.operations",
        "storage.local",
        "storage.objects.object_store",
        *CODEC_MODULES,
        *FORMAT_MODULES,
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.posed_images.image_log",
        "genre_tasks.logs.synthetic",
    )
    # The other cells need PostgreSQL and minutes.
    smallest = SmallestForm({"inputs": "60"}, only="fuzz")

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the measurements.

        Args:
            options: ``seeds`` and ``street``, the parameters of the streets; ``preset``, ``throughput_preset`` of the
                many logs, and ``settings``; ``cached_street``, of the streets that come from the store; ``cluster``,
                logs x workers, and ``seconds_scale`` of its stages; ``inputs`` of the fuzzers.
            quick: fewer rounds.

        Returns:
            Six cells.
        """
        seeds = split_option(options["seeds"])
        logs = [f"synthetic:street?seed={seed}{options['street']}" for seed in seeds]
        cached = [f"synthetic:street?seed={seed}{options['cached_street']}" for seed in seeds[:4]]
        settings = settings_from_options(options)
        tiny = tuple(TINY_SETTINGS.split())
        # Of a log that comes from the store, the size of its images plays no part.
        preset, small = options["preset"], options["throughput_preset"]
        rounds = 1 if quick else 3
        cluster_logs, _, workers = options["cluster"].partition("x")
        log = f"synthetic:street?seed={seeds[0]}"
        return [
            Cell("throughput", 1200.0, partial(measure_throughput, logs, small, settings), _parameters(options)),
            Cell("orchestration", 200.0, partial(measure_orchestration, log, preset, settings), _parameters(options)),
            Cell("cached", 300.0, partial(measure_cached_logs, cached, "demo", tiny, rounds), _parameters(options)),
            Cell(
                "object_store", 600.0, partial(measure_object_store, logs[0], preset, settings, rounds), {"n": rounds}
            ),
            Cell(
                "cluster",
                1800.0,
                partial(measure_cluster, int(cluster_logs), int(workers), 0, float(options["seconds_scale"])),
                _parameters(options),
            ),
            Cell("fuzz", 120.0, partial(measure_input_fuzz, int(options["inputs"]), 0), _parameters(options)),
        ]

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims.

        Args:
            rows: by cell.

        Yields:
            Claim: each once.
        """
        wanted = {name: row for name, row in rows.items() if "not_measured" not in row}
        throughput = wanted.get("throughput", {}).get("ratio")
        data = "16 logs of 8 frames, the seconds with one worker over those with two, one thread each"
        yield claim("scale.two_workers", throughput, ">=", 1.7, "ratio", data)
        share = wanted.get("orchestration", {}).get("share")
        data = "a worker's time without computation over the computation, one log of the preset small, one thread"
        yield claim("scale.orchestration_share", share, "<=", 0.05, "ratio", data)
        yield _claim_quartiles("cached_log_s", wanted.get("cached", {}).get("seconds"), 3.0, "s", "of a worker's time")
        overhead = wanted.get("object_store", {}).get("ratio")
        yield _claim_quartiles("object_store_ratio", overhead, 1.1, "ratio", "a run on S3 over one on a local store")
        cluster = wanted.get("cluster", {}).get("stages", {})
        # Counted in the store: a stage that two workers computed has two manifests, or one that was refused.
        for name in ("lost", "doubled"):
            measured = _as_float(cluster.get(name))
            yield claim(f"scale.cluster_{name}", measured, "<=", 0.0, "stages", "logs on a simulated cluster")
        findings = None if "fuzz" not in wanted else float(len(wanted["fuzz"]["findings"]))
        yield claim("scale.fuzz_findings", findings, "<=", 0.0, "inputs", "damaged and harmful files of all formats")

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Makes the table that the command prints.

        Args:
            rows: by cell.

        Yields:
            str: lines of Markdown.
        """
        fuzz = rows.get("fuzz", {})
        if "formats" in fuzz:
            yield "| format | read | refused | findings |"
            yield "|---|---|---|---|"
            for name, counts in fuzz["formats"].items():
                found = sum(counts[outcome] for outcome in FINDINGS)
                yield f"| {name} | {counts['read']} | {counts['refused']} | {found} |"
        yield from list_not_measured(rows)


def _as_float(value: int | None) -> float | None:
    return None if value is None else float(value)


def _parameters(options: Mapping[str, str]) -> dict[str, str]:
    return dict(options)


def _claim_quartiles(name: str, measured: Row | None, most: float, unit: str, data: str) -> Claim:
    if measured is None:
        return claim(f"scale.{name}", None, "<=", most, unit, data)
    spread = (measured["low"], measured["high"])
    return claim(f"scale.{name}", measured["median"], "<=", most, unit, data, int(measured["n"]), spread)


BENCH: Bench = Scale()
