"""The chunks of a run as a viewer shows them, read from the store when they are asked for."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from flows.reconstruction.stored_values import SCENE_STAGES, find_last_stage
from flows.simulation.edited_runs import open_run, open_shown_scenes
from flows.simulation.run_scenes import RunScenes
from flows.simulation.stored_ranges import SideRange, find_side_ranges
from flows.viewer.path_colors import SHIFTS_M, PathColors, measure_path_colors
from flows.viewer.path_drawing import CameraImage, PathDrawing, collect_images, draw_path
from flows.viewer.scene_nodes import SceneNodes, build_scene_nodes, select_rows
from genre_tasks.ego_paths.recorded_path import list_image_times, measure_frame_times
from genre_tasks.errors import InputError
from genre_tasks.logs.types import Float64
from genre_tasks.progress import Progress, silent
from genre_tasks.scene.chunk import Chunk
from genre_tasks.scene.graph import SceneGraph
from genre_tasks.scene_edits.actor_names import name_actors

CACHED_SCENES = 3
"""Scenes that stay in memory: going back and forth between the stages of a chunk reads nothing again."""


@dataclass(frozen=True)
class ViewedChunk:
    """A chunk after a stage, ready to be drawn.

    Attributes:
        log: name of the log.
        number: of the chunk.
        stage: initial, gnet or enet.
        frames: log frames, in order.
        times_s: [F] seconds from the first frame on.
        chunk_SE3_ego: [F, 4, 4] recorded poses, x forward, y left, z up.
        scene: nodes of Gaussians.
        path: the recorded path on the ground.
        images: recorded images with their cameras.
    """

    log: str
    number: int
    stage: str
    frames: tuple[int, ...]
    times_s: Float64
    chunk_SE3_ego: Float64
    scene: SceneNodes
    path: PathDrawing
    images: tuple[CameraImage, ...]

    @property
    def actor_names(self) -> tuple[str, ...]:
        """Names of the nodes that move, in the order of the scene."""
        return tuple(node.name for node in self.scene.nodes if node.motion is not None)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """Cameras with an image, in the order of the rig."""
        return tuple(dict.fromkeys(image.camera for image in self.images))


class ViewedRun:
    """A run for a viewer; several threads may use it.

    Args:
        store: folder (or URI) of the store.
        run: the run's name, or the start of it.
        max_splats: Gaussians to show of a scene; ``None``: all.

    Raises:
        InputError: there is no such run.
    """

    def __init__(self, store: str, run: str, max_splats: int | None = None) -> None:
        self._scenes = RunScenes(store, run)
        self._store = store
        self._max_splats = max_splats
        self._names: Mapping[str, str] | None = None
        # One reader at a time: two clients that ask for one scene must not build it twice.
        self._lock = threading.RLock()
        self._range_lock = threading.Lock()
        self._cache: dict[tuple[int, str], ViewedChunk] = {}

    @property
    def name(self) -> str:
        """The run's full name."""
        return str(self._scenes.record["run"])

    @property
    def log(self) -> str:
        """The log's URI."""
        return str(self._scenes.record["log"])

    @property
    def folder(self) -> Path:
        """The run's folder in the store, with its report."""
        return self._scenes.folder

    @property
    def chunk_numbers(self) -> tuple[int, ...]:
        """Numbers of the chunks, in the order of the log."""
        return tuple(self._scenes.chunk_numbers)

    def list_stages(self, number: int) -> tuple[str, ...]:
        """Lists the stages of a chunk that have made a scene, in their order.

        Args:
            number: of the chunk.
        """
        entries = [entry for entry in self._scenes.record["chunks"] if entry["chunk"] == number]
        found = {stage["stage"] for entry in entries for stage in entry["stages"]}
        return tuple(stage for stage in SCENE_STAGES if stage in found)

    def select(self, number: int | None, stage: str | None) -> tuple[int, str]:
        """Fills in what a user has not chosen.

        Args:
            number: of a chunk; ``None``: the first one.
            stage: of it; ``None``: the last one.

        Returns:
            Both.

        Raises:
            InputError: the run has no such chunk or stage.
        """
        chosen = self.chunk_numbers[0] if number is None else number
        if chosen not in self.chunk_numbers:
            available = ", ".join(map(str, self.chunk_numbers))
            raise InputError(f"the run has no chunk {chosen}", remedy=f"It has {available}.", log=self.log)
        stages = self.list_stages(chosen)
        if stage is not None and stage not in stages:
            remedy = f"It has {', '.join(stages)}."
            raise InputError(f"the run has no scene of the stage '{stage}'", remedy=remedy, chunk=chosen)
        return chosen, stage or find_last_stage(self._store, self.name, chosen)

    def load(self, number: int, stage: str, progress: Progress = silent) -> ViewedChunk:
        """Reads a chunk and its scene.

        Args:
            number: of the chunk.
            stage: initial, gnet or enet.
            progress: called while the path's views are rendered, where the scene asks for it.

        Returns:
            What is drawn.

        Raises:
            InputError: there is no such chunk or stage, or an image cannot be decoded.
            ArtifactCorruptError: an artifact is damaged.
        """
        with self._lock:
            viewed = self._cache.pop((number, stage), None) or self._build(number, stage, progress)
            # Put at the end, so that the one that was not asked for longest goes first.
            self._cache[(number, stage)] = viewed
            if len(self._cache) > CACHED_SCENES:
                del self._cache[next(iter(self._cache))]
            return viewed

    def find_range(self, number: int, stage: str, progress: Progress = silent) -> SideRange:
        """Reads the reliable range of a chunk's scene, or computes it once for all.

        Args:
            number: of the chunk.
            stage: initial, gnet or enet.
            progress: called while it is computed, which takes a minute.

        Returns:
            Metres to the left and right. That of an edited run is the recorded one's.

        Raises:
            OSError: the store cannot be written.
        """
        with self._range_lock:
            return find_side_ranges(open_run(self._store, self.name, stage, [number]).recorded, progress)[number]

    def _build(self, number: int, stage: str, progress: Progress) -> ViewedChunk:
        loaded = RunScenes(self._store, self.name, stage, [number]).load(number)
        chunk = loaded.chunk
        if self._names is None:
            # Behind an edited run are the names of the recorded one, as all commands take them.
            self._names = name_actors(open_shown_scenes(self._store, self.name))
        return ViewedChunk(
            log=chunk.log,
            number=number,
            stage=stage,
            frames=chunk.frames,
            times_s=measure_frame_times(chunk.frames, list_image_times(chunk)),
            chunk_SE3_ego=chunk.chunk_SE3_ego,
            scene=self._build_scene(chunk, loaded.scene, progress),
            path=draw_path(chunk),
            images=collect_images(chunk),
        )

    def _build_scene(self, chunk: Chunk, scene: SceneGraph, progress: Progress) -> SceneNodes:
        limit = self._max_splats
        too_many = limit is not None and len(scene) > limit
        measured: PathColors | None = None
        if too_many or scene.spherical_harmonics is not None:
            # The colour is that of the path alone; what is left out counts beside it as well.
            measured = measure_path_colors(scene, chunk, SHIFTS_M if too_many else SHIFTS_M[:1], progress)
        rows = None
        if measured is not None and limit is not None:
            rows = select_rows(measured.weights, scene.nodes.cpu().numpy(), limit)
        return build_scene_nodes(
            scene,
            chunk.frames,
            self._names or {},
            center=chunk.chunk_SE3_ego[:, :3, 3].mean(0),
            colors=None if measured is None else measured.colors,
            rows=rows,
        )
