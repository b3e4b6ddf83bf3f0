"""Figures of re-simulation: methods along a swerve, and a scene whose traffic is edited."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flows.experiments.stages import StageRunner, run_stages
from flows.paper_tables.comparison_strips import ComparisonStrip
from flows.paper_tables.layouts import Row
from flows.paper_tables.request import CheckedRequest
from flows.paper_tables.rollouts import START_OFFSET_M, TableRollout
from flows.paper_tables.simulation_scores import LogMeasurement
from flows.perception.camera_names import select_front_camera
from flows.pipeline.definition import stages_until
from flows.pipeline.log_cache import cached_log
from flows.simulation.stage_scenes import StageScenes
from genre_tasks.config import PipelineConfig
from genre_tasks.ego_paths.ego_path import EgoPath
from genre_tasks.ego_paths.frame_clock import measure_clock
from genre_tasks.errors import InputError
from genre_tasks.metrics.scoring import decode_view_image
from genre_tasks.render import render_views
from genre_tasks.rollout.render_rollout import render_rollout
from genre_tasks.rollout.rig import RigCamera
from genre_tasks.scene.box_projection import project_box
from genre_tasks.scene.chunk import Chunk, View
from genre_tasks.scene_edits.actor_library import ActorLibrary
from genre_tasks.scene_edits.actor_names import name_actors, resolve_actor
from genre_tasks.scene_edits.chunk_scene import SceneSource
from genre_tasks.scene_edits.edited_scenes import EditedScenes
from genre_tasks.scene_edits.edits import Edit, EditList, Insert, Move, Remove
from storage.codecs.png import to_pixels

MOMENTS = 5
"""Columns of the figure of a swerve, spread evenly over its path."""
EDITED_METHOD = "GenRe+"
"""The row of table 6 whose scene is edited: per-scene 3DGS has no actors that could be."""
INSERTED_AHEAD_M = 10.0
INSERTED_LEFT_M = 3.5
MOVED_M = 3.0
"""Where the figure of edits puts the inserted and the moved actor."""
_LEAST_CHANGE = 0.002
"""Mean difference of sRGB at which an edit shows in a camera."""


def swerve_strips(
    checked: CheckedRequest, runner: StageRunner, camera: str | None = None, start_offset_m: float = START_OFFSET_M
) -> list[ComparisonStrip]:
    """Renders a swerve with every method of the table, on the request's first log.

    Args:
        checked: the table's rows and the chunks of one log; rows that cannot be measured are left out.
        runner: runs one stage.
        camera: name of a camera; the first front one if ``None``.
        start_offset_m: where the swerve starts, metres to the left.

    Returns:
        The methods in the order of their table, after them the truth where the log can tell it.

    Raises:
        InputError: the log has no such camera.
        ConfigError: it has no room for a swerve.
    """
    strips: list[ComparisonStrip] = []
    places = checked.group_places()[0]
    for row in checked.measurable_rows:
        jobs = [checked.basis.job(checked.layout, row.method, where) for where in places]
        refs = [run_stages(stages_until(row.method.end), job, runner) for job in jobs]
        log = LogMeasurement(jobs, refs, row.method.end)
        path = _select_moments(log.plan(TableRollout("swerve", start_offset_m)).path)
        rig = (_find_camera(log.rig, camera),)
        captions = _describe_moments(path, log.recorded)
        images = [to_pixels(images.color[0]) for images in render_rollout(log.scenes, path, rig)]
        strips.append(ComparisonStrip(row.label, tuple(images), captions))
    # Every method drives the same path with the same rig, so the last one's serve the truth too.
    truth = cached_log(places[0].log).truth
    if truth is not None and strips:
        poses = path.world_SE3_ego @ rig[0].ego_SE3_camera
        cast = [truth.image(round(f), pose, rig[0].lens) for f, pose in zip(path.frames, poses, strict=True)]
        strips.append(ComparisonStrip("the truth", tuple(cast), captions))
    return strips


def manipulation_strips(
    checked: CheckedRequest,
    runner: StageRunner,
    actor: str | None = None,
    camera: str | None = None,
    frame: int | None = None,
) -> list[ComparisonStrip]:
    """Edits one actor of a scene of GenRe+: removed, inserted once more, and moved.

    Args:
        checked: the table and the chunks of one log.
        runner: runs one stage.
        actor: readable name, number or track id; if ``None`` the one that fills most of an image.
        camera: the only camera to show; if ``None`` all in which an edit shows.
        frame: of the log; if ``None`` the one at which the actor fills most of an image.

    Returns:
        A row for each camera: recorded image, render, and the render of each edit.

    Raises:
        InputError: there is no such actor or camera, or no image shows it.
    """
    row = _find_row(checked)
    jobs = [checked.basis.job(checked.layout, row.method, where) for where in checked.group_places()[0]]
    refs = [run_stages(stages_until(row.method.end), job, runner) for job in jobs]
    scenes = StageScenes(jobs, refs, row.method.end)
    names = name_actors(scenes)
    track_id = None if actor is None else resolve_actor(actor, names)
    best = _find_largest_box(scenes, track_id, camera, frame)
    edited = _edit_actor(scenes, PipelineConfig.model_validate(jobs[0].config), best, names[best.track_id])
    views = [v for v in best.chunk.views if v.frame == best.view.frame and camera in (None, v.camera)]
    columns = {name: _render(source, best.chunk.index, views) for name, source in edited.items()}
    original = columns["as recorded"]
    strips = []
    for k, view in enumerate(views):
        change = max(float((color[k] - original[k]).abs().mean()) for color in columns.values())
        # A camera that looks elsewhere would fill a row with equal images.
        if camera is None and change < _LEAST_CHANGE:
            continue
        recorded = to_pixels(decode_view_image(view))
        images = (recorded, *(to_pixels(color[k]) for color in columns.values()))
        captions = (f"frame {view.frame}, image", *(f"{names[best.track_id]} {name}" for name in columns))
        strips.append(ComparisonStrip(view.camera, images, captions))
    if not strips:
        raise InputError("no camera shows the edits", remedy="Choose another --actor or --frame.", log=best.chunk.log)
    return strips


@dataclass(frozen=True)
class _ActorView:
    # The recorded image that an actor fills most of.
    chunk: Chunk
    view: View
    track_id: str
    area: float
    left_of_ego: bool


def _select_moments(path: EgoPath) -> EgoPath:
    index = np.linspace(0, len(path) - 1, MOMENTS).round().astype(int)
    # At whole frames, as behaviours keep the log's: the truth knows no others.
    return EgoPath(path.times_s[index], path.frames[index], path.world_SE3_ego[index])


def _describe_moments(path: EgoPath, recorded: EgoPath) -> tuple[str, ...]:
    captions = []
    for time_s, pose in zip(path.times_s, path.world_SE3_ego, strict=True):
        nearest = np.linalg.norm(recorded.world_SE3_ego[:, :3, 3] - pose[:3, 3], axis=1).argmin()
        left_m = (np.linalg.inv(recorded.world_SE3_ego[nearest]) @ pose)[1, 3]
        captions.append(f"{time_s:.1f} s, {left_m:+.1f} m")
    return tuple(captions)


def _find_camera(rig: Sequence[RigCamera], name: str | None) -> RigCamera:
    names = [camera.name for camera in rig]
    chosen = name or select_front_camera(names)
    if chosen not in names:
        raise InputError(f"the log has no camera {chosen}", remedy=f"Cameras: {', '.join(names)}.")
    return rig[names.index(chosen)]


def _find_row(checked: CheckedRequest) -> Row:
    return next(row for row in checked.measurable_rows if row.label == EDITED_METHOD)


def _find_largest_box(scenes: StageScenes, track_id: str | None, camera: str | None, frame: int | None) -> _ActorView:
    found: list[_ActorView] = []
    for number in scenes.chunk_numbers:
        chunk = scenes.load(number).chunk
        for view in chunk.views:
            if camera not in (None, view.camera) or frame not in (None, view.frame):
                continue
            ego = chunk.chunk_SE3_ego[chunk.frames.index(view.frame)]
            for actor in chunk.actors:
                if track_id not in (None, actor.track_id) or not len(actor.points):
                    continue
                area = _measure_area(*project_box(actor, view), view)
                if area > 0:
                    box = actor.chunk_SE3_box[list(actor.frames).index(view.frame)]
                    left = (np.linalg.inv(ego) @ box)[1, 3] > 0
                    found.append(_ActorView(chunk, view, actor.track_id, area, bool(left)))
    if not found:
        raise InputError(
            f"no image shows {'an actor' if track_id is None else f'the actor {track_id}'}",
            remedy="Choose another --actor, --camera, --frame or --chunk.",
        )
    return max(found, key=lambda item: item.area)


def _measure_area(first: NDArray[np.int64], last: NDArray[np.int64], view: View) -> float:
    """Pixels of a box that is in the image as a whole; of one that the edge cuts, a hundredth of them."""
    area = float(np.prod(last - first))
    # An actor that is cut by the edge says little about an edit, so it is the last choice.
    is_cut = first[0] <= 0 or last[0] >= view.lens.width_px
    return area / 100 if is_cut else area


def _edit_actor(scenes: SceneSource, config: PipelineConfig, best: _ActorView, name: str) -> dict[str, SceneSource]:
    # The edit's start is in seconds, to which pauses of the recording add.
    clock = measure_clock(scenes.load(number).chunk for number in scenes.chunk_numbers)
    moment_s = float(clock.find_times([best.view.frame])[0])
    # To the other side of the ego vehicle than the actor, where nothing of it was.
    left_m = -INSERTED_LEFT_M if best.left_of_ego else INSERTED_LEFT_M
    insert = Insert(
        actor=name, name="inserted", ahead_m=INSERTED_AHEAD_M, left_m=left_m, speed_m_s=0.0, start_s=moment_s
    )
    edits: dict[str, Edit] = {
        "removed": Remove(actor=name),
        "inserted again": insert,
        "moved": Move(actor=name, left_m=MOVED_M),
    }

    def open_run(run: str) -> SceneSource:
        raise InputError(f"the figure has no run {run}", remedy="Insert an actor of its log.")

    library = ActorLibrary(open_run)
    edited = {
        key: EditedScenes(scenes, EditList(edits=(edit,)), library, config.simulate) for key, edit in edits.items()
    }
    return {"as recorded": scenes, **edited}


def _render(source: SceneSource, number: int, views: Sequence[View]) -> Tensor:
    # [V, H, W, 3]; the scene's tensors may ask for gradients, whose buffers a picture does not need.
    with torch.no_grad():
        return render_views(source.load(number).scene, views).color.clamp(0, 1).cpu()
