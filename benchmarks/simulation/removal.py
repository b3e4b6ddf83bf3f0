"""Actors that are removed: what they hid against the truth, and that nothing else changes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.common.bench import NotMeasuredError, Row
from benchmarks.common.claims import Claim, claim
from benchmarks.common.scores import pooled_psnr
from benchmarks.common.timing import Quartiles
from benchmarks.simulation.scenes import (
    LogScenes,
    SimulationCase,
    edit_scenes,
    log_label,
    open_scenes,
    recorded_views,
    source_views,
    truth_view,
)
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.logs.synthetic.edited_truth import EditedStreet, find_changed_pixels
from genre_tasks.logs.synthetic.traffic_edits import build_street_layout, remove_actor
from genre_tasks.logs.types import Float32
from genre_tasks.render import render_views
from genre_tasks.rollout.fix_rollout import RolloutFixer
from genre_tasks.rollout.render_rollout import RolloutImages, render_rollout
from genre_tasks.rollout.rig import RolloutView
from genre_tasks.scene.graph import FIRST_ACTOR, SceneGraph
from genre_tasks.scene_edits.chunk_scene import SceneSource
from genre_tasks.scene_edits.edits import Remove
from genre_tasks.stages.fnet import load_configured_fnet

LEAST_ACTORS = 3
MOST_ACTORS = 4
VIEWS_PER_ACTOR = 3
LEAST_PSNR = 22.0
MOST_CHANGE = 2.0
_SMALL_PX = (80, 45)
# Of an image: a smaller actor has too few pixels for a PSNR.
_LEAST_AREA = 0.004
_FRAMES_BETWEEN_VIEWS = 5
# Gaussians reach over an actor's outline by a pixel or two.
_RIM_PX = 3


@dataclass(frozen=True)
class ChosenView:
    """A recorded view in which an actor is large.

    Attributes:
        chunk: number of the chunk.
        view: camera and log frame.
        area: share of the image that the actor covers.
    """

    chunk: int
    view: RolloutView
    area: float


@dataclass(frozen=True)
class _Removal:
    """A removed actor.

    Attributes:
        name: its track id.
        edited: the scenes without it.
        before: the true street with it.
        after: the true street without it.
        fixer: fills what it hid.
    """

    name: str
    edited: SceneSource
    before: EditedStreet
    after: EditedStreet
    fixer: RolloutFixer


def measure_removal(case: SimulationCase) -> Row:
    """Removes the actors of a street that cover most of the images, one at a time.

    Args:
        case: the street.

    Returns:
        ``actors``: for each its name, squared errors and pixel counts where another frame saw what lies behind and
        where none did, and the largest changes of pixels outside.

    Raises:
        NotMeasuredError: the log has no truth, or fewer actors than the claim needs.
    """
    scenes = open_scenes(case)
    street = scenes.street
    layout = build_street_layout(street)
    before = EditedStreet(street, layout)
    chosen = choose_views(scenes, before)
    if len(chosen) < LEAST_ACTORS:
        raise NotMeasuredError(f"{len(chosen)} moving actors are large enough in the images, {LEAST_ACTORS} are needed")
    config = scenes.config
    network = load_configured_fnet(config.fnet)
    actors = []
    for name, views in chosen.items():
        after = EditedStreet(street, remove_actor(layout, name))
        edited = edit_scenes(scenes, Remove(actor=scenes.names[name]))
        # One for each actor: it remembers what recorded images show without it.
        fixer = RolloutFixer(config.fnet, scenes.source, config.novel_views.lidar_max_points, network)
        removal = _Removal(name, edited, before, after, fixer)
        found = [_measure_view(scenes, removal, view) for view in views]
        actors.append({"actor": name, "views": found})
    return {"log": case.log, "chunks": list(case.chunks), "actors": actors}


def choose_views(scenes: LogScenes, street: EditedStreet) -> dict[str, list[ChosenView]]:
    """Chooses the actors that cover most of the recorded images, and the views in which they do.

    Args:
        scenes: of the street.
        street: as it was recorded.

    Returns:
        Views by track id, largest first, some frames apart; the actors with the largest view first.
    """
    found: dict[str, list[ChosenView]] = {}
    for number, chunk in zip(scenes.source.chunk_numbers, scenes.chunks, strict=True):
        names = {actor.track_id for actor in chunk.actors}
        for view in recorded_views(chunk, scenes.rig):
            # Small images: only areas are asked for.
            small = truth_view(chunk, view.frame, view.chunk_SE3_camera, view.lens.resized(*_SMALL_PX))
            for name, visible in street.find_actors(small).items():
                # The scene has those that ingest took for moving ones.
                if name in names and visible.mean() >= _LEAST_AREA:
                    found.setdefault(name, []).append(ChosenView(number, view, float(visible.mean())))
    largest = sorted(found.items(), key=lambda item: -max(v.area for v in item[1]))
    return {name: _spread(views) for name, views in largest[:MOST_ACTORS]}


def _spread(views: Sequence[ChosenView]) -> list[ChosenView]:
    """The largest views, some frames apart from each other."""
    out: list[ChosenView] = []
    for candidate in sorted(views, key=lambda v: -v.area):
        distances = [abs(candidate.view.frame - other.view.frame) for other in out]
        if len(out) < VIEWS_PER_ACTOR and min(distances, default=math.inf) >= _FRAMES_BETWEEN_VIEWS:
            out.append(candidate)
    return out


def _measure_view(scenes: LogScenes, removal: _Removal, chosen: ChosenView) -> Row:
    """Measures one view with and without an actor."""
    recorded = scenes.source.load(chosen.chunk)
    view = truth_view(recorded.chunk, chosen.view.frame, chosen.view.chunk_SE3_camera, chosen.view.lens)
    image_before = render_image(recorded.scene, chosen.view)
    images = _render_without(scenes, removal, chosen)
    rendered = images.color[0].numpy()
    filled = removal.fixer.fill(images).color[0].numpy()
    truth = removal.after.image(view).astype(np.float32) / np.float32(255)
    covered = removal.before.mask_actors(view, [removal.name])
    points, is_still = removal.after.find_background(view)
    was_recorded = removal.before.find_recorded_points(points, source_views(recorded.chunk))
    weight = render_actor_weight(recorded.scene, removal.name, chosen.view)
    shadow = find_changed_pixels(removal.before, removal.after, view)
    near = ndimage.binary_dilation(covered | shadow, iterations=_RIM_PX)
    outside = ~(covered | shadow | (weight > 0))
    areas = {
        "recorded": covered & is_still & was_recorded,
        "never_recorded": covered & is_still & ~was_recorded,
        # Without it a low number of the removal could be the scene's fault.
        "around": ndimage.binary_dilation(covered, iterations=10) & ~near,
    }
    row: Row = {"camera": chosen.view.camera, "frame": chosen.view.frame, "area": float(covered.mean())}
    for version, image in (("filled", filled), ("rendered", rendered)):
        error = np.square(image - truth).mean(2)
        change = np.abs(image - image_before).max(2) * 255
        row[version] = {name: _sum_errors(error, area) for name, area in areas.items()} | {
            "change_outside": float(change[outside].max(initial=0.0)),
            "share_changed_off_rim": float((change[~near] > MOST_CHANGE).mean()),
        }
    return row


def _render_without(scenes: LogScenes, removal: _Removal, chosen: ChosenView) -> RolloutImages:
    """The rollout's images of one camera at one recorded pose, without the actor."""
    chunk = scenes.source.load(chosen.chunk).chunk
    frame = int(chosen.view.frame)
    pose = chunk.world_SE3_chunk @ chunk.chunk_SE3_ego[chunk.frames.index(frame)]
    path = EgoPath(np.zeros(1), np.array([float(frame)]), pose[None])
    rig = [camera for camera in scenes.rig if camera.name == chosen.view.camera]
    return next(iter(render_rollout(removal.edited, path, rig)))


def render_image(scene: SceneGraph, view: RolloutView) -> Float32:
    """Renders one view of a scene.

    Args:
        scene: in the view's coordinates.
        view: camera and moment.

    Returns:
        [H, W, 3] sRGB in [0, 1].
    """
    with torch.no_grad():
        return np.asarray(render_views(scene, [view]).color[0].clamp(0, 1).numpy())


def render_actor_weight(scene: SceneGraph, name: str, view: RolloutView) -> Float32:
    """Renders how much an actor's Gaussians count in each pixel.

    Args:
        scene: in the view's coordinates.
        name: the actor's track id.
        view: camera and moment.

    Returns:
        [H, W] in [0, 1]; 0 where none of them contributes.
    """
    number = next(k for k, actor in enumerate(scene.actors) if actor.track_id == name)
    # Colours that say whose a Gaussian is: what is blended is then the weight.
    is_actor = (scene.nodes == FIRST_ACTOR + number).to(scene.gaussians.colors.dtype)
    gaussians = replace(scene.gaussians, colors=is_actor[:, None].expand(-1, 3).contiguous())
    marked = replace(scene, gaussians=gaussians, spherical_harmonics=None)
    return render_image(marked, view)[..., 0]


def _sum_errors(error: Float32, mask: NDArray[np.bool_]) -> Row:
    return {"squared_error": float(error[mask].sum(dtype=np.float64)), "pixels": int(mask.sum())}


def pool_psnr(parts: Sequence[Row]) -> float | None:
    """Computes the PSNR of the pixels of several views together.

    Args:
        parts: summed squared errors (means over channels) with their numbers of pixels.

    Returns:
        dB; ``None`` without a pixel.

    >>> pool_psnr([{"squared_error": 1.0, "pixels": 60}, {"squared_error": 0.0, "pixels": 40}])
    20.0
    """
    pixels = sum(part["pixels"] for part in parts)
    if not pixels:
        return None
    return pooled_psnr(sum(part["squared_error"] for part in parts), pixels)


def removal_claims(rows: Sequence[Row]) -> Iterator[Claim]:
    """Claims that removed actors leave what was behind them, and nothing else changes.

    They are about images as ``genre simulate --remove`` makes them, with what was hidden filled by FNet.

    Args:
        rows: see :func:`measure_removal`.
    """
    actors = [actor for row in rows for actor in row["actors"]]
    views = [view for actor in actors for view in actor["views"]]
    streets = ", ".join(log_label(row) for row in rows) or "no street"
    data = f"{len(actors)} actors in {len(views)} views; {streets}"
    found = [pool_psnr([view["filled"]["recorded"] for view in actor["views"]]) for actor in actors]
    values = [value for value in found if value is not None]
    quartiles = Quartiles.from_values(values) if values else None
    note = f"PSNR in an actor's pixels where another frame saw what is behind, the median actor; {data}"
    spread = None if quartiles is None else quartiles.spread
    median = None if quartiles is None else quartiles.median
    yield claim("simulation.removal_psnr", median, ">=", LEAST_PSNR, "dB", note, len(values), spread)
    note = f"the same, the worst actor; {data}"
    yield claim("simulation.removal_psnr_worst", min(values, default=None), ">=", LEAST_PSNR, "dB", note, len(values))
    change = max((view["filled"]["change_outside"] for view in views), default=None)
    note = f"largest change of a pixel outside the actor's true and rendered pixels and its shadow; {data}"
    yield claim("simulation.removal_outside", change, "<=", MOST_CHANGE, "of 255", note, len(views))


def removal_table(rows: Sequence[Row]) -> Iterator[str]:
    """Gives a line for each removed actor.

    Args:
        rows: see :func:`measure_removal`.
    """
    yield (
        "| log | removed actor | views | covers at most | images | PSNR where recorded, dB | pixels "
        "| where never recorded, dB | pixels | around it, dB | change outside, of 255 | changed beyond the rim |"
    )
    yield "|---|---|---|---|---|---|---|---|---|---|---|---|"
    for row in rows:
        for actor in row["actors"]:
            for version in ("filled", "rendered"):
                yield f"| {' | '.join(_describe_actor(row, actor, version))} |"


def _describe_actor(row: Row, actor: Row, version: str) -> tuple[str, ...]:
    views = [view[version] for view in actor["views"]]
    parts = {name: [view[name] for view in views] for name in ("recorded", "never_recorded", "around")}
    pixels = {name: str(sum(part["pixels"] for part in found)) for name, found in parts.items()}
    return (
        log_label(row),
        actor["actor"],
        str(len(views)),
        f"{max(view['area'] for view in actor['views']):.1%}",
        version,
        _format_db(pool_psnr(parts["recorded"])),
        pixels["recorded"],
        _format_db(pool_psnr(parts["never_recorded"])),
        pixels["never_recorded"],
        _format_db(pool_psnr(parts["around"])),
        f"{max(view['change_outside'] for view in views):.2f}",
        f"{max(view['share_changed_off_rim'] for view in views):.2%}",
    )


def _format_db(value: float | None) -> str:
    return "–" if value is None else f"{value:.1f}"
