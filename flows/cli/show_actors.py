"""``genre show actors RUN``: the actors of a run with their names, and a picture of each."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from genre_tasks.scene_edits.chunk_scene import SceneSource
    from genre_tasks.scene_edits.run_survey import RunSurvey

_TRACK_CHARACTERS = 10


def show_actors(store: str, run: str | None, picture: Path | None) -> None:
    """Prints a table of a run's actors, and draws them.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        picture: a PNG file for a sheet of pictures; ``None``: none is drawn.

    Raises:
        ConfigError: no run is named.
        InputError: there is no such run.
    """
    from flows.cli.printing import print_rows
    from flows.simulation.edited_runs import open_shown_scenes
    from genre_tasks.errors import ConfigError
    from genre_tasks.scene_edits.run_survey import survey_run

    if run is None:
        raise ConfigError("no run is named", remedy="Write `genre show actors RUN`; `genre show runs` lists them.")
    scenes = open_shown_scenes(store, run)
    survey = survey_run(scenes)
    print_rows("actors", [_actor_row(survey, track_id, name) for track_id, name in survey.names.items()])
    if picture is not None:
        _write_sheet(scenes, survey.names, picture)


def _actor_row(survey: RunSurvey, track_id: str, name: str) -> dict[str, Any]:
    from genre_tasks.scene_edits.trajectories import Trajectory, measure_speed

    track = survey.tracks[track_id]
    path = Trajectory(track.frames, track.world_SE3_box, track.frames.astype(float))
    return {
        "name": name,
        "class": track.label,
        "size m": " x ".join(f"{side:.1f}" for side in track.size_m),
        "frames": f"{track.frames[0]}-{track.frames[-1]}",
        "points": max(track.gaussians.values()),
        "speed m/s": round(measure_speed(path, survey.clock), 1),
        "chunks": ", ".join(str(number) for number in sorted(track.gaussians)),
        # The start of a track id names the actor as well, and UUIDs would fill the terminal.
        "track": track_id[:_TRACK_CHARACTERS],
    }


def _write_sheet(scenes: SceneSource, names: Mapping[str, str], path: Path) -> None:
    from flows.plots.actor_pictures import draw_actors
    from flows.simulation.run_scenes import RunScenes
    from genre_tasks.atomic_path import atomic_path
    from genre_tasks.errors import InputError
    from storage.codecs.png import write_png

    image = draw_actors(scenes, names, is_recorded=isinstance(scenes, RunScenes))
    if image is None:
        raise InputError("this run has no actors, so there is no picture", remedy="Leave out --picture.")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as part:
        write_png(part, image)
    typer.echo(f"wrote {path}")
