"""Random behaviours against the kinematic bounds, and impossible requests against clear errors."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.simulation.scenes import SimulationCase, edit_scenes, log_label, open_scenes
from flows.pipeline.log_cache import cached_log
from flows.simulation.request import SimulationRequest
from flows.simulation.rollout_path import check_path
from genre_tasks.config import SimulateConfig
from genre_tasks.ego_paths.behaviour_request import Side
from genre_tasks.ego_paths.behaviours import BEHAVIOURS, plan_behaviour
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.kinematics import find_bound_violations
from genre_tasks.ego_paths.world_actors import list_world_actors
from genre_tasks.errors import ConfigError, GenreError, InputError
from genre_tasks.scene_edits.edits import Remove

RANDOM_BEHAVIOURS = 1000
_SEED = 40
_FRAME_S = 0.1
_MOST_OFFSET_M = 4.0
_MOST_STRENGTH = 1.5


def measure_plausibility(logs: Sequence[str], count: int = RANDOM_BEHAVIOURS) -> Row:
    """Plans random behaviours on the recorded paths of logs, and checks them against the bounds.

    Args:
        logs: URIs; their paths take turns.
        count: number of behaviours.

    Returns:
        ``planned`` and ``within``: how many were planned, and how many of those keep within all bounds; ``refused``:
        how many were refused, by behaviour; ``worst``: the violations.

    Raises:
        NotMeasuredError: there is no log.
    """
    if not logs:
        raise NotMeasuredError("there is no log whose path could be driven otherwise")
    # Fixed: the same behaviours in every run.
    rng = np.random.default_rng(_SEED)
    paths = [_read_recorded_path(log) for log in logs]
    config = SimulateConfig()
    names = [name for name in BEHAVIOURS if name != "recorded"]
    planned: Counter[str] = Counter()
    refused: Counter[str] = Counter()
    without_numbers = []
    violations = []
    for k in range(count):
        recorded = paths[k % len(paths)]
        name = str(rng.choice(names))
        sides: tuple[Side | None, ...] = ("left", "right", None) if BEHAVIOURS[name].has_side else (None,)
        side = sides[int(rng.integers(len(sides)))]
        offset_m = float(rng.uniform(-_MOST_OFFSET_M, _MOST_OFFSET_M))
        strength = float(rng.uniform(0, _MOST_STRENGTH))
        delay_s = float(rng.uniform(0, recorded.times_s[-1]))
        try:
            path = plan_behaviour(
                name, recorded, config, start_offset_m=offset_m, strength=strength, delay_s=delay_s, side=side
            )
        except (ConfigError, InputError) as error:
            refused[name] += 1
            if not _has_number(error):
                without_numbers.append(str(error))
            continue
        planned[name] += 1
        violations += [f"{name} {k}: {violation}" for violation in find_bound_violations(path, config.bounds)]
    broken = len({text.partition(":")[0] for text in violations})
    return {
        "logs": list(logs),
        "asked": count,
        "planned": sum(planned.values()),
        "within": sum(planned.values()) - broken,
        "planned_by_behaviour": dict(planned),
        "refused_by_behaviour": dict(refused),
        "refusals_without_numbers": without_numbers[:5],
        "violations": violations[:20],
    }


def _read_recorded_path(uri: str) -> EgoPath:
    log = cached_log(uri)
    frames = np.arange(log.frame_count)
    times = np.array([log.frame_timestamp_s(int(frame)) for frame in frames])
    poses = np.stack([log.world_SE3_lidar(int(frame)) for frame in frames])
    return EgoPath(times - times[0], frames.astype(np.float64), poses)


def _has_number(error: GenreError) -> bool:
    return re.search(r"\d", str(error)) is not None


def measure_refusals(case: SimulationCase) -> Row:
    """Asks for what is impossible, and looks at the errors.

    Args:
        case: a street.

    Returns:
        ``requests``: for each what was asked, the kind of error (``null``: none came) and its text.
    """
    scenes = open_scenes(case)
    recorded = scenes.recorded
    config = scenes.config.simulate
    actors = list_world_actors(scenes.chunks)
    boxes = actors[0].place_boxes(recorded.frames)
    first = int(np.flatnonzero(boxes.exists)[0])
    # The whole path moved so that it starts where the actor is.
    shift = np.eye(4)
    shift[:2, 3] = boxes.center_m[first, :2] - recorded.world_SE3_ego[first, :2, 3]
    inside = EgoPath(recorded.times_s, recorded.frames, shift @ recorded.world_SE3_ego)
    empty = EgoPath(np.zeros(0), np.zeros(0), np.zeros((0, 4, 4)))
    request = SimulationRequest(store=case.store, run="run", out=Path("out"))
    requests: dict[str, Callable[[], object]] = {
        "an unknown actor": lambda: edit_scenes(scenes, Remove(actor="car-99")),
        "a path without frames": lambda: plan_behaviour("brake", empty, config, start_offset_m=0.0),
        "a start inside a car": lambda: check_path(request, config, inside, recorded, actors),
        "a swerve of 70 m": partial(plan_behaviour, "swerve", recorded, config, start_offset_m=0.0, strength=20.0),
        "a start 500 m aside": lambda: plan_behaviour("brake", recorded, config, start_offset_m=500.0),
        "an unknown behaviour": lambda: plan_behaviour("fly", recorded, config, start_offset_m=0.0),
    }
    found = [{"request": name} | _describe_error(action) for name, action in requests.items()]
    return {"log": case.log, "chunks": list(case.chunks), "requests": found}


def _describe_error(action: Callable[[], object]) -> Row:
    try:
        action()
    except (ConfigError, InputError) as error:
        return {"error": type(error).__name__, "text": str(error)}
    return {"error": None, "text": ""}


_NEEDS_NO_NUMBER = ("an unknown behaviour",)


def plausibility_claims(rows: Sequence[Row], refusals: Sequence[Row]) -> Iterator[Claim]:
    """Claims that planned behaviours keep within the bounds, and that what is impossible ends in one clear error.

    Args:
        rows: see :func:`measure_plausibility`.
        refusals: see :func:`measure_refusals`.
    """
    planned = sum(row["planned"] for row in rows)
    asked = sum(row["asked"] for row in rows)
    share = sum(row["within"] for row in rows) / planned if planned else None
    note = f"planned behaviours within all bounds; {asked} random ones, {asked - planned} refused with an error"
    yield claim("simulation.plausible", share, ">=", 1.0, "share", note, planned)
    requests = [request for row in refusals for request in row["requests"]]
    good = [_is_clear(request) for request in requests]
    share = sum(good) / len(good) if good else None
    note = "impossible requests that end in one InputError or ConfigError, with numbers where there are any"
    yield claim("simulation.clear_errors", share, ">=", 1.0, "share", note, len(good))


def _is_clear(request: Row) -> bool:
    has_number = re.search(r"\d", request["text"]) is not None
    return request["error"] is not None and (has_number or request["request"] in _NEEDS_NO_NUMBER)


def plausibility_table(rows: Sequence[Row], refusals: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each behaviour, and one for each impossible request.

    Args:
        rows: see :func:`measure_plausibility`.
        refusals: see :func:`measure_refusals`.
    """
    yield "| random behaviour | planned | refused |"
    yield "|---|---|---|"
    for row in rows:
        for name in sorted(row["planned_by_behaviour"].keys() | row["refused_by_behaviour"].keys()):
            planned = row["planned_by_behaviour"].get(name, 0)
            yield f"| {name} | {planned} | {row['refused_by_behaviour'].get(name, 0)} |"
        yield f"\n{row['within']} of {row['planned']} planned behaviours are within all bounds."
    yield ""
    yield "| log | impossible request | error | message |"
    yield "|---|---|---|---|"
    for row in refusals:
        for request in row["requests"]:
            text = request["text"].replace("|", "/").replace("\n", " ")
            yield f"| {log_label(row)} | {request['request']} | {request['error'] or 'none'} | {text} |"
