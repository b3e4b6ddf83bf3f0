"""Re-simulation: other behaviours and other traffic, scored against the truth of the synthetic streets.

genre bench simulation --json docs/results/data/simulation.json [--set seeds=1001&frames=40] [--set pandaset=]

The scenes are those of the paper's protocol on all chunks of each log. Stages that the store lacks are computed, which
takes minutes a log; ``genre table 6`` on the same logs and store leaves everything that the first cells need.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

from benchmarks.common.bench import (
    TINY_SETTINGS,
    TINY_STREET,
    Bench,
    Cell,
    Row,
    SmallestForm,
    list_not_measured,
    settings_from_options,
)
from benchmarks.common.claims import Claim
from benchmarks.common.lazy_modules import STAGE_MODULES
from benchmarks.common.task import has_log_folder
from benchmarks.simulation.behaviour_quality import (
    COMPARED_METHODS,
    behaviour_claims,
    behaviour_table,
    list_rollouts,
    measure_behaviours,
)
from benchmarks.simulation.insertion import insertion_claims, insertion_table, measure_insertion
from benchmarks.simulation.lidar import measure_lidar
from benchmarks.simulation.lidar_report import lidar_claims, lidar_table
from benchmarks.simulation.plausibility import (
    RANDOM_BEHAVIOURS,
    measure_plausibility,
    measure_refusals,
    plausibility_claims,
    plausibility_table,
)
from benchmarks.simulation.removal import measure_removal, removal_claims, removal_table
from benchmarks.simulation.scenes import METHOD, SimulationCase, cases_from_options
from benchmarks.simulation.speed import MEMORY_POSES, measure_memory, measure_speed, speed_claims, speed_table
from benchmarks.simulation.steadiness import (
    flicker_claims,
    flicker_table,
    handover_claims,
    handover_table,
    measure_flicker,
    measure_handover,
)
from flows.pipeline.definition import STAGE_BY_NAME, digest_stage_weights
from genre_tasks.config import PipelineConfig

# Estimates for two quiet cores. Behaviours come first, and make the scenes that the other cells find in the store.
_BEHAVIOURS_S = 500.0
_REMOVAL_S = 60.0
_INSERTION_S = 45.0
_FLICKER_S = 240.0
_HANDOVER_S = 35.0
_PLAUSIBILITY_S = 30.0
_REFUSALS_S = 4.0
_LIDAR_S = 120.0
_SPEED_S = 60.0
_MEMORY_S = 90.0
_ROUNDS = 3
_QUICK_BEHAVIOURS = 100
_QUICK_POSES = 200


class SimulationBench:
    """A cell for each log and claim."""

    name = "simulation"
    options: Mapping[str, str] = {
        "seeds": "1001&frames=40,1002&frames=40,1003&frames=40,1004&frames=40,1005&frames=40",
        "compared": "",
        "chunks": "0,1",
        "store": "genre-store",
        "pandaset": "../shared/data/pandaset/002",
        # The published 30,000 take half an hour a chunk on two cores.
        "settings": "gnet.per_scene.iterations=1000",
    }
    code: tuple[str, ...] = (
        "benchmarks.simulation.behaviour_quality",
        "benchmarks.simulation.insertion",
        "benchmarks.simulation.lidar",
        "benchmarks.simulation.plausibility",
        "benchmarks.simulation.removal",
        "benchmarks.simulation.speed",
        "benchmarks.simulation.steadiness",
        # They drive, render and score.
        "flows.paper_tables.rollouts",
        "flows.paper_tables.simulation_scores",
        "flows.simulation.outputs",
        # Behaviours are looked up by name.
        "genre_tasks.ego_paths.relative_path",
        "genre_tasks.ego_paths.recorded_driving",
        "genre_tasks.ego_paths.brake",
        "genre_tasks.ego_paths.accelerate",
        "genre_tasks.ego_paths.lane_change",
        "genre_tasks.ego_paths.swerve",
        *STAGE_MODULES,
        "genre_tasks.logs.pandaset.reader",
        "genre_tasks.logs.synthetic",
    )
    smallest = SmallestForm(
        {"seeds": TINY_STREET, "chunks": "0", "pandaset": "", "settings": TINY_SETTINGS},
        "plausibility",
    )

    def cells(self, options: Mapping[str, str], quick: bool) -> list[Cell]:
        """Lists the cells; ``quick``: the first log alone, fewer rollouts, behaviours and poses."""
        settings = settings_from_options(options)
        cases = cases_from_options(options, settings)
        real = [case for case in cases if case.log.startswith("pandaset:")]
        streets = [case for case in cases if case not in real]
        # Logs that are not there are left out of the key too, so that it changes when one is downloaded.
        logs = [case.log for case in cases if has_log_folder(case.log)]
        if quick:
            streets = streets[:1]
            real = real[: not streets]
        rollouts = list_rollouts(quick)
        count = _QUICK_BEHAVIOURS if quick else RANDOM_BEHAVIOURS
        poses = _QUICK_POSES if quick else MEMORY_POSES
        cells = [
            Cell(
                "plausibility", _PLAUSIBILITY_S, partial(measure_plausibility, logs, count), {"logs": logs, "n": count}
            )
        ]
        # Per-scene methods take minutes a chunk, so that they may be compared on fewer streets; empty: on all.
        compared = cases_from_options({**options, "seeds": options["compared"] or options["seeds"]}, settings)
        for case in [case for case in [*streets, *real] if case in compared]:
            parameters = _describe_case(case)
            driven = parameters | {"rollouts": [str(rollout) for rollout in rollouts]}
            seconds = _BEHAVIOURS_S * len(rollouts) / 8
            cells.append(Cell(f"behaviours {case.log}", seconds, partial(measure_behaviours, case, rollouts), driven))
        for case in streets:
            parameters = _describe_case(case)
            cells += [
                Cell(f"removal {case.log}", _REMOVAL_S, partial(measure_removal, case), parameters),
                Cell(f"insertion {case.log}", _INSERTION_S, partial(measure_insertion, case), parameters),
                Cell(f"flicker {case.log}", _FLICKER_S, partial(measure_flicker, case), parameters),
                Cell(f"hand-over {case.log}", _HANDOVER_S, partial(measure_handover, case), parameters),
            ]
        cells += [
            Cell(f"hand-over {case.log}", _HANDOVER_S, partial(measure_handover, case), _describe_case(case))
            for case in real
        ]
        for case in real:
            for chunk in case.chunks:
                measure = partial(measure_lidar, case.log, chunk, case.store, settings=settings)
                name = f"lidar {case.log} chunk {chunk}"
                cells.append(Cell(name, _LIDAR_S, measure, _describe_case(case)))
        # Of one log: what they measure is the machine and the code more than the street.
        for case in streets[:1]:
            parameters = _describe_case(case)
            long = parameters | {"poses": poses}
            timed = parameters | {"rounds": _ROUNDS}
            cells += [
                Cell(f"refusals {case.log}", _REFUSALS_S, partial(measure_refusals, case), parameters),
                Cell(f"speed {case.log}", _SPEED_S, partial(measure_speed, case, _ROUNDS), timed),
                Cell(f"memory {case.log}", _MEMORY_S, partial(measure_memory, case, poses), long),
            ]
        return cells

    def claims(self, rows: Mapping[str, Row]) -> Iterator[Claim]:
        """Makes the claims of issue and guide, section by section."""
        yield from behaviour_claims(_select(rows, "behaviours"))
        yield from removal_claims(_select(rows, "removal"))
        yield from insertion_claims(_select(rows, "insertion"))
        yield from flicker_claims(_select(rows, "flicker"))
        yield from handover_claims(_select(rows, "hand-over"))
        yield from lidar_claims(_select(rows, "lidar"))
        yield from speed_claims(_select(rows, "speed"), _select(rows, "memory"))
        yield from plausibility_claims(_select(rows, "plausibility"), _select(rows, "refusals"))

    def table(self, rows: Mapping[str, Row]) -> Iterator[str]:
        """Gives a table for each section, and what was not measured."""
        found = {kind: _select(rows, kind) for kind in {name.split()[0] for name in rows}}
        speed = (found.get("speed", []), found.get("memory", []))
        plausibility = (found.get("plausibility", []), found.get("refusals", []))
        sections: list[tuple[str, Callable[..., Iterator[str]], tuple[list[Row], ...]]] = [
            ("Behaviours", behaviour_table, (found.get("behaviours", []),)),
            ("Removed actors", removal_table, (found.get("removal", []),)),
            ("Inserted actors", insertion_table, (found.get("insertion", []),)),
            ("Flicker", flicker_table, (found.get("flicker", []),)),
            ("Hand-over between chunks", handover_table, (found.get("hand-over", []),)),
            ("LiDAR", lidar_table, (found.get("lidar", []),)),
            ("Speed and memory", speed_table, speed),
            ("Plausibility", plausibility_table, plausibility),
        ]
        first = True
        for title, make_table, arguments in sections:
            if any(arguments):
                # A table first: the command's output begins with one.
                if not first:
                    yield f"\n{title}\n"
                first = False
                yield from make_table(*arguments)
        yield from list_not_measured(rows)


def _select(rows: Mapping[str, Row], kind: str) -> list[Row]:
    """The rows of one kind of cell that were measured."""
    return [row for name, row in rows.items() if name.split()[0] == kind and "not_measured" not in row]


def _describe_case(case: SimulationCase) -> dict[str, object]:
    """What scenes depend on beyond the code, for the cells' cache."""
    configurations = {method: case.jobs(method)[0].config for method in (METHOD, *COMPARED_METHODS)}
    config = PipelineConfig.model_validate(configurations[METHOD])
    weights = [digest_stage_weights(STAGE_BY_NAME[stage], config) for stage in ("gnet", "fnet", "enet")]
    return {"chunks": list(case.chunks), "configurations": configurations, "weights": weights}


BENCH: Bench = SimulationBench()
