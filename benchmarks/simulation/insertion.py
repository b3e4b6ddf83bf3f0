"""Actors that are inserted the other way round, and edits that are undone."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.scores import pooled_psnr
from benchmarks.common.timing import Quartiles
from benchmarks.simulation.removal import render_image
from benchmarks.simulation.scenes import (
    LogScenes,
    SimulationCase,
    edit_scenes,
    log_label,
    open_scenes,
    truth_view,
)
from genre_tasks.logs.synthetic.edited_truth import EditedStreet
from genre_tasks.logs.synthetic.street_layout import StreetLayout
from genre_tasks.logs.synthetic.traffic_edits import (
    build_street_layout,
    find_actor,
    follow_boxes,
    insert_actor,
    remove_actor,
)
from genre_tasks.logs.types import Float32
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene_edits.chunk_scene import ChunkScene, SceneSource
from genre_tasks.scene_edits.edits import Edit, Insert, Move, Remove

LEAST_ACTORS = 3
MOST_ACTORS = 3
_COPY = "copy"
_AHEAD_M = 20.0
# Three views on the way towards it.
_STEPS = (1, 6, 11)
_LEAST_GAUSSIANS = 100


@dataclass(frozen=True)
class _Insertion:
    """A copy of an actor in the scene and on the true street.

    Attributes:
        scene: of the first chunk, with the copy alone in it.
        street: the same street.
    """

    scene: ChunkScene
    street: EditedStreet


def measure_insertion(case: SimulationCase) -> Row:
    """Puts actors ahead of the ego vehicle, as they face and turned by 180°, and moves actors away and back.

    Args:
        case: the street.

    Returns:
        ``actors``: for each the PSNR against the truth of the turned actor, in the pixels of either, of the turned
        copy and of one that is not turned; ``round_trips``: for each whether scene and image have the same bytes.

    Raises:
        NotMeasuredError: the log has no truth, or fewer actors than the claim needs.
    """
    scenes = open_scenes(case)
    layout = build_street_layout(scenes.street)
    names = _choose_actors(scenes)
    if len(names) < LEAST_ACTORS:
        raise NotMeasuredError(f"{len(names)} actors have {_LEAST_GAUSSIANS} Gaussians, {LEAST_ACTORS} are needed")
    return {
        "log": case.log,
        "chunks": list(case.chunks),
        "actors": [_measure_turn(scenes, layout, name) for name in names],
        "round_trips": _measure_round_trips(scenes, names),
    }


def _choose_actors(scenes: LogScenes) -> list[str]:
    """Track ids of the actors with most Gaussians in the first chunk."""
    scene = scenes.source.load(scenes.source.chunk_numbers[0]).scene
    counts = {actor.track_id: int((scene.nodes == FIRST_ACTOR + k).sum()) for k, actor in enumerate(scene.actors)}
    ordered = sorted(counts, key=lambda name: (-counts[name], name))
    return [name for name in ordered if counts[name] >= _LEAST_GAUSSIANS][:MOST_ACTORS]


def _measure_turn(scenes: LogScenes, layout: StreetLayout, name: str) -> Row:
    turned = _insert(scenes, layout, name, turn_deg=180.0)
    straight = _insert(scenes, layout, name, turn_deg=0.0)
    errors: dict[str, list[float]] = {"turned": [], "straight": []}
    pixels = 0
    for view in _approach(scenes):
        chunk = turned.scene.chunk
        place = truth_view(chunk, view.frame, view.chunk_SE3_camera, view.lens)
        truth = turned.street.image(place).astype(np.float32) / np.float32(255)
        area = turned.street.mask_actors(place, [_COPY]) | straight.street.mask_actors(place, [_COPY])
        pixels += int(area.sum())
        for key, inserted in (("turned", turned), ("straight", straight)):
            errors[key] += _squared_errors(render_image(inserted.scene.scene, view), truth, area)
    psnr = {key: pooled_psnr(math.fsum(values), len(values)) for key, values in errors.items()}
    return {"actor": name, "label": find_actor(layout, name).label, "pixels": pixels, "psnr": psnr}


def _insert(scenes: LogScenes, layout: StreetLayout, name: str, turn_deg: float) -> _Insertion:
    """A copy that stands ahead of the ego vehicle, on a street without other traffic."""
    # Without other traffic nothing hides the copy, and nothing else of the image differs.
    edits: list[Edit] = [Remove(actor=readable) for readable in scenes.names.values()]
    edits.append(Insert(actor=scenes.names[name], name=_COPY, ahead_m=_AHEAD_M, turn_deg=turn_deg, speed_m_s=0.0))
    scene = edit_scenes(scenes, *edits).load(scenes.source.chunk_numbers[0])
    node = next(actor for actor in scene.scene.actors if actor.track_id == _COPY)
    empty = layout
    for actor in layout.actors:
        empty = remove_actor(empty, actor.name)
    original = find_actor(layout, name)
    boxes = scene.chunk.world_SE3_chunk @ node.chunk_SE3_box
    motion = follow_boxes(node.frames, boxes, node.size_m[2], scenes.street.offset_m)
    return _Insertion(scene, EditedStreet(scenes.street, insert_actor(empty, original, _COPY, motion)))


def _approach(scenes: LogScenes) -> list[RolloutView]:
    """Views of the first camera, while the ego vehicle comes nearer."""
    chunk = scenes.chunks[0]
    camera = scenes.rig[0]
    steps = [step for step in _STEPS if step < len(chunk.frames)]
    return [
        RolloutView(camera.name, float(chunk.frames[k]), chunk.chunk_SE3_ego[k] @ camera.ego_SE3_camera, camera.lens)
        for k in steps
    ]


def _squared_errors(image: Float32, truth: Float32, area: NDArray[np.bool_]) -> list[float]:
    errors: list[float] = np.square(image - truth).mean(2)[area].tolist()
    return errors


def _measure_round_trips(scenes: LogScenes, names: Sequence[str]) -> list[Row]:
    """Moves actors away, one at a time, and back."""
    number = scenes.source.chunk_numbers[0]
    view = _approach(scenes)[0]
    before = _digest(scenes.source, number, view)
    found = []
    for name in names:
        readable = scenes.names[name]
        away = Move(actor=readable, forward_m=2.3, left_m=-0.7)
        back = Move(actor=readable, forward_m=-2.3, left_m=0.7)
        moved = edit_scenes(scenes, away)
        moved_digest = _digest(moved, number, view)
        returned_digest = _digest(edit_scenes(scenes, away, back), number, view)
        found.append(
            {
                "actor": name,
                "changes_when_away": moved_digest["scene"] != before["scene"],
                "same_scene": returned_digest["scene"] == before["scene"],
                "same_image": returned_digest["image"] == before["image"],
            }
        )
    return found


def _digest(source: SceneSource, number: int, view: RolloutView) -> dict[str, str]:
    scene = source.load(number).scene
    image = np.ascontiguousarray(render_image(scene, view))
    return {"scene": _digest_scene(scene), "image": hashlib.sha256(image.tobytes()).hexdigest()}


def _digest_scene(scene: SceneGraph) -> str:
    state = hashlib.sha256()
    g = scene.gaussians
    tensors = [g.means, g.log_scales, g.quats, g.logit_opacities, g.colors, scene.nodes]
    if scene.spherical_harmonics is not None:
        tensors.append(scene.spherical_harmonics)
    for tensor in tensors:
        state.update(tensor.detach().contiguous().numpy().tobytes())
    for actor in scene.actors:
        state.update(actor.track_id.encode())
        state.update(np.ascontiguousarray(actor.frames).tobytes())
        state.update(np.ascontiguousarray(actor.chunk_SE3_box).tobytes())
    return state.hexdigest()


def insertion_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that a turned copy shows its other side, and that an edit that is undone leaves no trace.

    Args:
        rows: see :func:`measure_insertion`.
    """
    actors = [actor for row in rows for actor in row["actors"]]
    trips = [trip for row in rows for trip in row["round_trips"]]
    streets = ", ".join(log_label(row) for row in rows) or "no street"
    gains = [actor["psnr"]["turned"] - actor["psnr"]["straight"] for actor in actors]
    quartiles = Quartiles.from_values(gains) if gains else None
    note = "PSNR to the true actor at 180°: of the copy at 180° less that of one at 0°, the median actor"
    yield claim(
        "simulation.insertion_turned",
        None if quartiles is None else quartiles.median,
        ">",
        0.0,
        "dB",
        f"{note}; {len(actors)} actors; {streets}",
        len(gains),
        None if quartiles is None else quartiles.spread,
    )
    # An edit that changed nothing would come back too.
    good = [t["changes_when_away"] and t["same_scene"] and t["same_image"] for t in trips]
    share = sum(good) / len(good) if good else None
    note = f"moved away and back: the same bytes of scene and image; {len(trips)} actors; {streets}"
    yield claim("simulation.round_trip", share, ">=", 1.0, "share of actors", note, len(trips))


def insertion_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each inserted actor.

    Args:
        rows: see :func:`measure_insertion`.
    """
    yield "| log | inserted actor | pixels | PSNR to the car at 180°, dB: copy at 180° | copy at 0° | moved and back |"
    yield "|---|---|---|---|---|---|"
    for row in rows:
        trips = {trip["actor"]: trip for trip in row["round_trips"]}
        for actor in row["actors"]:
            trip = trips[actor["actor"]]
            same = "the same bytes" if trip["same_scene"] and trip["same_image"] else "differs"
            psnr = actor["psnr"]
            numbers = f"{actor['pixels']} | {psnr['turned']:.2f} | {psnr['straight']:.2f}"
            yield f"| {log_label(row)} | {actor['actor']} | {numbers} | {same} |"
