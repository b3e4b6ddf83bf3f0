"""Actors of finished runs, ready to be put into other scenes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.scene.chunk import Points
from genre_tasks.scene_edits.actor_names import resolve_actor
from genre_tasks.scene_edits.actor_parts import ActorPart, extract_part
from genre_tasks.scene_edits.chunk_scene import SceneSource
from genre_tasks.scene_edits.run_survey import RunSurvey, Track, survey_run
from genre_tasks.scene_edits.symmetry import complete_by_symmetry, complete_points_by_symmetry
from genre_tasks.scene_edits.tone import measure_road_color

_MAX_CLEARANCE_M = 0.5


@dataclass(frozen=True)
class LibraryActor:
    """An actor that was taken out of a run.

    Attributes:
        track: its recorded path.
        part: its Gaussians, of the chunk that has most of them; the side that no camera saw is mirrored.
        points: its LiDAR points in that chunk, mirrored as its Gaussians are.
        chunk: number of that chunk.
        shape_frames: [F] the log frames in which that chunk has it.
        clearance_m: from the ground to the bottom of its box, the median over its path.
        road_color: [3] of the road in that chunk, linear light; ``None``: unknown.
    """

    track: Track
    part: ActorPart
    points: Points
    chunk: int
    shape_frames: Float64
    clearance_m: float
    road_color: Float64 | None


class ActorLibrary:
    """Looks up actors in finished runs.

    Args:
        open_run: opens a run by its name, as the edit list has it.
    """

    def __init__(self, open_run: Callable[[str], SceneSource]) -> None:
        self._open_run = open_run
        self._runs: dict[str, tuple[SceneSource, RunSurvey]] = {}

    def take(self, run: str, actor: str) -> tuple[LibraryActor, RunSurvey]:
        """Takes an actor out of a run.

        Args:
            run: its name.
            actor: as a user names it.

        Returns:
            The actor, and the run that it is from.

        Raises:
            InputError: there is no such run or actor, or it has no Gaussians.
        """
        if run not in self._runs:
            source = self._open_run(run)
            self._runs[run] = source, survey_run(source)
        source, survey = self._runs[run]
        track_id = resolve_actor(actor, survey.names)
        return take_actor(source, survey, track_id), survey


def take_actor(source: SceneSource, survey: RunSurvey, track_id: str) -> LibraryActor:
    """Takes an actor out of the chunk that has most Gaussians of it.

    Args:
        source: the scenes of a run.
        survey: of that run.
        track_id: of the actor.

    Returns:
        The actor.

    Raises:
        InputError: no chunk has a Gaussian of it.
    """
    track = survey.tracks[track_id]
    # The earlier chunk where two have the same number.
    chunk_number = max(track.gaussians, key=lambda number: (track.gaussians[number], -number))
    if not track.gaussians[chunk_number]:
        name = survey.names[track_id]
        raise InputError(f"the actor {name} has no Gaussians", remedy="LiDAR never hit it; choose another actor.")
    chunk_scene = source.load(chunk_number)
    number = next(k for k, a in enumerate(chunk_scene.scene.actors) if a.track_id == track_id)
    node = chunk_scene.scene.actors[number]
    # A run that is edited itself may show it with a shadow, which stays behind.
    part = extract_part(chunk_scene.scene, number, chunk_scene.shadow_counts.get(track_id, 0))
    views = chunk_scene.chunk.views
    points = chunk_scene.chunk.actors[number].points
    return LibraryActor(
        track=track,
        part=complete_by_symmetry(part, node, views),
        points=complete_points_by_symmetry(points, node, views, deforms=part.deformation is not None),
        chunk=chunk_number,
        shape_frames=node.frames.astype(np.float64),
        clearance_m=measure_clearance(survey, track),
        road_color=measure_road_color(chunk_scene, survey.ground),
    )


def measure_clearance(survey: RunSurvey, track: Track) -> float:
    """Measures how far the bottom of an actor's box is from the ground.

    Args:
        survey: of the run.
        track: of the actor.

    Returns:
        Metres, the median over its path, limited to half a metre; negative below the ground.
    """
    bottom = track.bottoms
    # A few places suffice for a median.
    places = bottom[:: max(1, len(bottom) // 10)]
    height, _ = survey.ground.measure(places[:, :2])
    return float(np.median(places[:, 2] - height).clip(-_MAX_CLEARANCE_M, _MAX_CLEARANCE_M))
