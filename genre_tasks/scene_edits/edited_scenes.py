"""The scenes of a run with edited traffic: edits are applied to each chunk when it is read."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from genre_tasks.config.simulation_sections import SimulateConfig
from genre_tasks.errors import InputError
from genre_tasks.scene.actor_node import ActorNode
from genre_tasks.scene.chunk import Actor, Points
from genre_tasks.scene.transforms import invert_se3
from genre_tasks.scene_edits.actor_library import ActorLibrary, LibraryActor, measure_clearance, take_actor
from genre_tasks.scene_edits.actor_names import make_slug, resolve_actor
from genre_tasks.scene_edits.actor_parts import (
    ActorPart,
    PlacedActor,
    add_shadow,
    assemble_edited_scene,
    extract_part,
    select_deformation,
    trim_to_box,
)
from genre_tasks.scene_edits.chunk_scene import CHUNKS_IN_MEMORY, ChunkScene, SceneSource
from genre_tasks.scene_edits.contact_shadow import build_contact_shadow
from genre_tasks.scene_edits.edits import ActorChange, EditList, Insert, Remove, combine_changes
from genre_tasks.scene_edits.insertion import place_inserted
from genre_tasks.scene_edits.run_survey import survey_run
from genre_tasks.scene_edits.symmetry import complete_by_symmetry, complete_points_by_symmetry
from genre_tasks.scene_edits.tone import apply_tone, match_tone, measure_road_color
from genre_tasks.scene_edits.trajectories import Trajectory, change_trajectory


@dataclass(frozen=True)
class _ChangedActor:
    # A recorded actor with its new path in world coordinates; no path: it is removed.
    track_id: str
    change: ActorChange
    trajectory: Trajectory | None


@dataclass(frozen=True)
class _InsertedActor:
    name: str
    actor: LibraryActor
    trajectory: Trajectory
    change: ActorChange
    from_here: bool


class EditedScenes:
    """A run with edited traffic; a ``SceneSource``.

    An actor whose edits cancel out keeps its arrays, and a chunk in which nothing changes is that of the source. Edits
    of edited scenes are combined with the earlier ones before they are applied.

    Args:
        source: the scenes of the run.
        edits: what is changed.
        library: where inserted actors of other runs are from.
        config: darkness of contact shadows.
        chunks: numbers of the chunks that are shown; ``None``: those of ``source``. Names, tracks and the ground are
            those of all chunks in any case, so that an edit means the same in any selection.

    Attributes:
        edits: all edits, with those of ``source`` where that was edited before.
        names: readable name by track id, of recorded and inserted actors, whether removed or not.

    Raises:
        InputError: an edit names an actor or a run that does not exist, or a new actor has a name that is taken.
    """

    def __init__(
        self,
        source: SceneSource,
        edits: EditList,
        library: ActorLibrary,
        config: SimulateConfig,
        chunks: Sequence[int] | None = None,
    ) -> None:
        self.edits: EditList = edits
        self._source: SceneSource = source
        self._numbers: Sequence[int] = [n for n in source.chunk_numbers if chunks is None or n in chunks]
        if isinstance(source, EditedScenes):
            # Applied together: what was moved away and is moved back now is where it was, to the bit.
            self.edits = source.edits + edits
            self._source = source._source
        self._library = library
        self._config = config
        self._survey = survey_run(self._source)
        self._edit_numbers = {id(edit): k for k, edit in enumerate(self.edits.edits, start=1)}
        inserts = self._name_inserts()
        self.names = {**self._survey.names, **{name: name for name in inserts}}
        changes = self._combine()
        self._inserted = tuple(
            self._insert(name, edit, changes.get(name, ActorChange())) for name, edit in inserts.items()
        )
        self._changed = {
            track_id: self._change(track_id, change)
            for track_id, change in changes.items()
            if track_id in self._survey.tracks and not change.is_identity
        }
        self._adopted: dict[str, LibraryActor] = {}
        self._edit = lru_cache(CHUNKS_IN_MEMORY)(self._edit_chunk)

    @property
    def chunk_numbers(self) -> Sequence[int]:
        """Numbers of the chunks that are shown, in the order of the log."""
        return self._numbers

    @property
    def changed_names(self) -> dict[str, str]:
        """Readable names of the recorded actors that edits take away or change, by track id."""
        return {track_id: self.names[track_id] for track_id in self._changed}

    def load(self, number: int) -> ChunkScene:
        """Reads one chunk and its scene, and edits them; the last two stay in memory.

        Args:
            number: of the chunk.

        Returns:
            The edited chunk and scene; ``removed`` are the actors as they were recorded that are away or elsewhere.
        """
        return self._edit(number)

    def _edit_chunk(self, number: int) -> ChunkScene:
        base = self._source.load(number)
        removed = [node for node in base.scene.actors if node.track_id in self._changed]
        new = [*self._adopt(number, base), *self._place_inserted(number, base)]
        if not removed and not new:
            return base
        placed: list[PlacedActor] = []
        actors: list[Actor] = []
        for k, node in enumerate(base.scene.actors):
            actor = self._place_recorded(base, k)
            if actor is not None:
                placed.append(actor)
                # An actor that no edit names keeps its very arrays.
                actors.append(base.chunk.actors[k] if actor.node is node else self._move_recorded(actor.node, base, k))
        for actor, points in new:
            placed.append(actor)
            node = actor.node
            actors.append(Actor(node.track_id, node.label, node.size_m, node.frames, node.chunk_SE3_box, points))
        return ChunkScene(
            chunk=replace(base.chunk, actors=tuple(actors)),
            scene=assemble_edited_scene(base.scene, placed),
            removed=(*base.removed, *removed),
            shadow_counts={a.node.track_id: a.part.shadow_count for a in placed if a.part is not None},
        )

    def _place_recorded(self, base: ChunkScene, k: int) -> PlacedActor | None:
        node = base.scene.actors[k]
        deformation = select_deformation(base.scene.deformation, k)
        changed = self._changed.get(node.track_id)
        if changed is None:
            return PlacedActor(node, node.frames.astype(np.float64), deformation, number=k)
        if changed.trajectory is None:
            return None
        trajectory = changed.trajectory.select_frames(base.chunk.frames)
        if not len(trajectory):
            return None
        return PlacedActor(
            node=_cut_node(node.track_id, node.label, node.size_m, trajectory, base),
            shape_frames=trajectory.shape_frames,
            deformation=deformation,
            part=self._with_shadow(changed, self._extract_recorded(base, k, changed.change)),
            keeps_shape=changed.change.keeps_motion,
        )

    def _adopt(self, number: int, base: ChunkScene) -> list[tuple[PlacedActor, Points]]:
        # Actors that a new time or speed brings into a chunk where they never were: taken from another chunk.
        present = {node.track_id for node in base.scene.actors}
        out = []
        for track_id, changed in self._changed.items():
            if track_id in present or changed.trajectory is None:
                continue
            trajectory = changed.trajectory.select_frames(base.chunk.frames)
            if not len(trajectory) or not any(self._survey.tracks[track_id].gaussians.values()):
                continue
            if track_id not in self._adopted:
                self._adopted[track_id] = take_actor(self._source, self._survey, track_id)
            actor = self._adopted[track_id]
            part = apply_tone(actor.part, match_tone(actor.road_color, measure_road_color(base, self._survey.ground)))
            node = _cut_node(track_id, actor.track.label, actor.track.size_m, trajectory, base)
            out.append((_new_actor(node, trajectory, self._with_shadow(changed, part)), actor.points))
        return out

    def _place_inserted(self, number: int, base: ChunkScene) -> list[tuple[PlacedActor, Points]]:
        out = []
        for inserted in self._inserted:
            trajectory = inserted.trajectory.select_frames(base.chunk.frames)
            if inserted.change.removed or not len(trajectory):
                continue
            actor = inserted.actor
            part = actor.part
            if not (inserted.from_here and actor.chunk == number):
                part = apply_tone(part, match_tone(actor.road_color, measure_road_color(base, self._survey.ground)))
            clearance = actor.clearance_m + float(inserted.change.up_m)
            shadow = build_contact_shadow(actor.track.size_m, clearance, self._config.contact_shadow)
            node = _cut_node(inserted.name, actor.track.label, actor.track.size_m, trajectory, base)
            out.append(
                (_new_actor(node, trajectory, add_shadow(trim_to_box(part, actor.track.size_m), shadow)), actor.points)
            )
        return out

    @staticmethod
    def _extract_recorded(base: ChunkScene, k: int, change: ActorChange) -> ActorPart:
        part = extract_part(base.scene, k)
        # An actor that is not turned shows the side that it showed before.
        return complete_by_symmetry(part, base.scene.actors[k], base.chunk.views) if change.turn_deg else part

    def _move_recorded(self, node: ActorNode, base: ChunkScene, k: int) -> Actor:
        """A recorded actor of the chunk on its new path; its points show the sides that its Gaussians show."""
        recorded = base.chunk.actors[k]
        points = recorded.points
        if self._changed[node.track_id].change.turn_deg:
            deforms = select_deformation(base.scene.deformation, k) is not None
            points = complete_points_by_symmetry(points, base.scene.actors[k], base.chunk.views, deforms=deforms)
        return replace(recorded, frames=node.frames, chunk_SE3_box=node.chunk_SE3_box, points=points)

    def _with_shadow(self, changed: _ChangedActor, part: ActorPart) -> ActorPart:
        track = self._survey.tracks[changed.track_id]
        clearance = measure_clearance(self._survey, track) + float(changed.change.up_m)
        shadow = build_contact_shadow(track.size_m, clearance, self._config.contact_shadow)
        return add_shadow(trim_to_box(part, track.size_m), shadow)

    def _change(self, track_id: str, change: ActorChange) -> _ChangedActor:
        if change.removed:
            return _ChangedActor(track_id, change, None)
        track = self._survey.tracks[track_id]
        recorded = Trajectory(track.frames, track.world_SE3_box, track.frames.astype(np.float64))
        survey = self._survey
        trajectory = change_trajectory(recorded, change, survey.clock, survey.ground)
        return _ChangedActor(track_id, change, trajectory)

    def _insert(self, name: str, edit: Insert, change: ActorChange) -> _InsertedActor:
        try:
            if edit.from_run is None:
                track_id = resolve_actor(edit.actor, self._survey.names)
                actor = take_actor(self._source, self._survey, track_id)
                clock = self._survey.clock
            else:
                actor, other = self._library.take(edit.from_run, edit.actor)
                clock = other.clock
            trajectory = place_inserted(edit, actor, clock, self._survey)
        except InputError as error:
            raise self._at_edit(edit, error) from error
        if not change.is_identity and not change.removed:
            trajectory = change_trajectory(trajectory, change, self._survey.clock, self._survey.ground)
        return _InsertedActor(name, actor, trajectory, change, from_here=edit.from_run is None)

    def _name_inserts(self) -> dict[str, Insert]:
        taken = {*self._survey.names, *self._survey.names.values()}
        out: dict[str, Insert] = {}
        for edit in self.edits.edits:
            if not isinstance(edit, Insert):
                continue
            # Numbered on, so that a bare number names one actor alone.
            name = edit.name or f"{self._name_class(edit)}-{len(taken) + len(out) + 1}"
            if name in taken or name in out:
                problem = f"an actor '{name}' is there already"
                raise self._at_edit(edit, InputError(problem, remedy="Give the inserted actor another name."))
            out[name] = edit
        return out

    def _name_class(self, edit: Insert) -> str:
        """Gives the first part of the actor's readable name; of another run's actor, of what the user wrote."""
        name = edit.actor
        if edit.from_run is None:
            # An actor that is not known is an error where it is taken.
            with suppress(InputError):
                name = self._survey.names[resolve_actor(name, self._survey.names)]
        return make_slug(name.rpartition("-")[0] or "actor")

    def _combine(self) -> dict[str, ActorChange]:
        by_actor: dict[str, list[object]] = {}
        removed_by: dict[str, int] = {}
        for edit in self.edits.edits:
            if isinstance(edit, Insert):
                continue
            try:
                track_id = resolve_actor(edit.actor, self.names)
            except InputError as error:
                raise self._at_edit(edit, error) from error
            if track_id in removed_by:
                problem = f"'{edit.actor}' was removed by edit {removed_by[track_id]}"
                remedy = "Leave out one of the two, or edit the run from before."
                raise self._at_edit(edit, InputError(problem, remedy=remedy))
            if isinstance(edit, Remove):
                removed_by[track_id] = self._edit_numbers[id(edit)]
            by_actor.setdefault(track_id, []).append(edit)
        return {track_id: combine_changes(edits) for track_id, edits in by_actor.items()}  # type: ignore[arg-type]

    def _at_edit(self, edit: object, error: InputError) -> InputError:
        number = self._edit_numbers[id(edit)]
        kind = getattr(edit, "kind", "")
        return InputError(f"edit {number} ({kind}): {error.problem}", remedy=error.remedy, file=error.file)


def _new_actor(node: ActorNode, trajectory: Trajectory, part: ActorPart) -> PlacedActor:
    return PlacedActor(node, trajectory.shape_frames, part.deformation, part=part, keeps_shape=False)


def _cut_node(
    track_id: str, label: str, size_m: tuple[float, float, float], trajectory: Trajectory, base: ChunkScene
) -> ActorNode:
    chunk_SE3_world = invert_se3(base.chunk.world_SE3_chunk)
    return ActorNode(track_id, label, size_m, trajectory.frames, chunk_SE3_world @ trajectory.world_SE3_box)
