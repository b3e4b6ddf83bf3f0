"""Readable names of a run's actors: one for each track, the same in all chunks."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Protocol, runtime_checkable

from genre_tasks.errors import InputError
from genre_tasks.scene_edits.chunk_scene import SceneSource
from genre_tasks.suggestions import did_you_mean

_LISTED = 40
"""More names than this are not listed in an error."""


@runtime_checkable
class NamedSource(Protocol):
    """Scenes that know the names of their actors: edited ones, whose actors keep the names of the recorded run."""

    @property
    def names(self) -> Mapping[str, str]:
        """Readable name by track id."""
        ...


def name_actors(source: SceneSource) -> dict[str, str]:
    """Names all actors of a run, in the order of their first frame and then of their track id.

    Args:
        source: the scenes of a run. Edited ones keep the names of the recorded run.

    Returns:
        Name by track id, such as ``car-3``; no number is there twice.
    """
    if isinstance(source, NamedSource):
        return dict(source.names)
    tracks: dict[str, tuple[int, str]] = {}
    for number in source.chunk_numbers:
        for actor in source.load(number).scene.actors:
            first = int(actor.frames[0]) if len(actor.frames) else 0
            known = tracks.get(actor.track_id, (first, actor.label))
            tracks[actor.track_id] = min(known, (first, actor.label))
    return number_tracks((first, track_id, label) for track_id, (first, label) in tracks.items())


def number_tracks(tracks: Iterable[tuple[int, str, str]]) -> dict[str, str]:
    """Numbers tracks from 1.

    Args:
        tracks: first frame, track id and label of each.

    Returns:
        Name by track id, in the order of the numbers.

    >>> number_tracks([(4, "b", "Car"), (0, "z", "Pick-up Truck")])
    {'z': 'pick-up-truck-1', 'b': 'car-2'}
    """
    # Names of tracks are made to be compared: "10" comes after "9".
    ordered = sorted(tracks, key=lambda track: (track[0], _natural_order(track[1])))
    return {track_id: f"{make_slug(label)}-{k}" for k, (_, track_id, label) in enumerate(ordered, start=1)}


def make_slug(label: str) -> str:
    """Writes a class as part of a name: letters and digits of ASCII with hyphens.

    Args:
        label: the log's word for a class.

    >>> make_slug("Other Vehicle - Construction"), make_slug("汽车")
    ('other-vehicle-construction', 'actor')
    """
    return re.sub(r"[^a-z0-9]+", "-", label.lower()).strip("-") or "actor"


def resolve_actor(word: str, names: Mapping[str, str]) -> str:
    """Finds the actor that a user means.

    A readable name counts first, then its number, then the log's track id, then the start of a name or of a track id.

    Args:
        word: what the user wrote.
        names: readable name by track id.

    Returns:
        The track id.

    Raises:
        InputError: no actor, or more than one, is meant.

    >>> resolve_actor("3", {"a71": "car-3", "b2": "bus-4"}), resolve_actor("bus", {"a71": "car-3", "b2": "bus-4"})
    ('a71', 'b2')
    """
    track_ids = {name: track_id for track_id, name in names.items()}
    if word in track_ids:
        return track_ids[word]
    by_number: dict[str, str] = {}
    for name, track_id in track_ids.items():
        _, hyphen, number = name.rpartition("-")
        if hyphen and number.isdecimal():
            # The first counts: an inserted actor, which comes last, may have been named like one of the log.
            by_number.setdefault(number, track_id)
    if word in by_number:
        return by_number[word]
    if word in names:
        return word
    found = [t for t, name in names.items() if word and (name.startswith(word) or t.startswith(word))]
    if len(found) == 1:
        return found[0]
    if found:
        problem = f"{len(found)} actors begin with '{word}': {_list_names(names[t] for t in found)}"
        raise InputError(problem, remedy="Write one of these names.")
    if not names:
        raise InputError(f"there is no actor '{word}'", remedy="This run has no actors at all.")
    suggestion = did_you_mean(word, [*track_ids, *names])
    remedy = f"{suggestion}`genre show actors RUN` shows them: {_list_names(track_ids)}."
    raise InputError(f"there is no actor '{word}'", remedy=remedy)


def _natural_order(track_id: str) -> tuple[tuple[int, str], ...]:
    parts = re.findall(r"[0-9]+|[^0-9]+", track_id)
    return tuple((int(part), "") if part.isdecimal() and part.isascii() else (-1, part) for part in parts)


def _list_names(names: Iterable[str]) -> str:
    listed = list(names)
    more = f" and {len(listed) - _LISTED} more" if len(listed) > _LISTED else ""
    return ", ".join(listed[:_LISTED]) + more
