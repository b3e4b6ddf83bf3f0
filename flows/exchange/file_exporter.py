"""Exports into files of Gaussians: a file for each node, chunk or frame, by what the format can hold."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from flows.exchange.export_request import ExportRequest
from flows.exchange.stored_scenes import StoredScenes
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.clouds import merge_clouds
from genre_tasks.exchange.conversion import pose_scene
from genre_tasks.exchange.one_cloud import make_resting_scene
from genre_tasks.exchange.scene_folder import (
    ChunkEntry,
    Layout,
    PosedFile,
    SceneDocument,
    describe_chunk,
    digest_files,
    write_document,
)
from genre_tasks.exchange.types import ExchangeFormat, ExchangeScene
from genre_tasks.progress import Progress

_STEM_CHARACTERS = 60

_RESTING_FILES = "The files themselves rest: where actors are at which time is in scene.json."
_POSED_FILES = "Each file is the scene at one frame: nothing in it moves."


@dataclass(frozen=True)
class _Part:
    """What one file holds.

    Attributes:
        name: of the file without its suffix, relative to the folder.
        scene: its contents.
        node: name of the node, where the file holds one alone.
        frame: log frame, where the file holds the scene at one.
    """

    name: str
    scene: ExchangeScene
    node: str | None = None
    frame: int | None = None


class FileExporter:
    """An exporter for any format of files.

    Args:
        exchange_format: that can write.
    """

    def __init__(self, exchange_format: ExchangeFormat) -> None:
        self._format = exchange_format

    def check(self, request: ExportRequest) -> None:
        """Checks that the format is written: see :meth:`flows.exchange.export_request.SceneExporter.check`.

        Raises:
            ConfigError: it is only read.
        """
        if not self._format.can_write:
            raise ConfigError(f"the format {self._format.name} is only read", remedy="Choose another --format.")

    def export(self, scenes: StoredScenes, request: ExportRequest, folder: Path, progress: Progress) -> dict[str, Any]:
        """Writes the files: see :meth:`flows.exchange.export_request.SceneExporter.export`.

        Returns:
            Numbers of chunks, nodes, files and bytes, of the Gaussians in all files, and the losses.

        Raises:
            InputError: no chunk has the frame, there is no actor to write, or a part does not fit into the format.
        """
        layout = _choose_layout(request, self._format.carries_nodes)
        numbers = list(scenes.chunk_numbers)
        entries: list[ChunkEntry] = []
        chunks_by_loss: dict[str, list[int]] = {}
        gaussians = 0
        for k, number in enumerate(numbers):
            scene = scenes.load(number)
            if request.frame is not None and request.frame not in scene.frames:
                continue
            if request.per_actor:
                scene = replace(scene, nodes=tuple(node for node in scene.nodes if node.motion is not None))
            losses_of_chunk = tuple(dict.fromkeys(self._list_losses(scene, layout)))
            entry = describe_chunk(number, scene, scenes.describe_chunk(number))
            if not self._format.carries_nodes:
                # Files of clouds keep no list of losses: an import finds in the document what they have rounded or cut.
                entry = entry.model_copy(update={"losses": losses_of_chunk})
            for loss in losses_of_chunk:
                chunks_by_loss.setdefault(loss, []).append(number)
            for part in _split_scene(number, scene, layout, request.frame):
                progress(k, len(numbers), part.name)
                entry = self._write_part(folder, entry, part, request.out)
                gaussians += sum(len(node.cloud) for node in part.scene.nodes)
            entries.append(entry)
        _check_found(entries, request, numbers)
        losses = _name_chunks(chunks_by_loss, len(entries)) + _describe_layout(layout, entries)
        files = digest_files(folder)
        document = SceneDocument(
            format=self._format.name,
            layout=layout,
            source=scenes.describe(),
            chunks=tuple(entries),
            losses=losses,
            files=files,
        )
        write_document(folder, document)
        return {
            "chunks": [entry.chunk for entry in entries],
            "nodes": sum(len(entry.nodes) for entry in entries),
            "gaussians": gaussians,
            "files": [file.path for file in files],
            "bytes": sum(file.size for file in files),
            "losses": list(losses),
        }

    def _list_losses(self, scene: ExchangeScene, layout: Layout) -> tuple[str, ...]:
        """Sentences on a chunk: what the scene has lost before, and what the format cannot carry."""
        written = scene
        if layout != "scenes":
            # As one part: that files rest and are several is said once, for all chunks.
            written = make_resting_scene(merge_clouds([node.cloud for node in scene.nodes]))
        return (*scene.losses, *self._format.describe_losses(written))

    def _write_part(self, folder: Path, entry: ChunkEntry, part: _Part, out: Path) -> ChunkEntry:
        """Writes one file into the folder, which is ``out`` later; the chunk's entry with that file in it."""
        file = f"{part.name}{self._format.suffixes[0]}"
        path = folder / file
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            self._format.write(path, part.scene)
        except InputError as error:
            # The folder is a hidden one, and gone before anybody reads the error.
            raise InputError(
                error.problem if part.node is None else f"{part.node}: {error.problem}",
                remedy=error.remedy,
                file=out / file,
                chunk=entry.chunk,
                frame=part.frame,
            ) from error
        if part.frame is not None:
            return entry.model_copy(update={"posed": (*entry.posed, PosedFile(frame=part.frame, file=file))})
        if part.node is None:
            return entry.model_copy(update={"file": file})
        nodes = tuple(n.model_copy(update={"file": file}) if n.name == part.node else n for n in entry.nodes)
        return entry.model_copy(update={"nodes": nodes})


def _choose_layout(request: ExportRequest, carries_nodes: bool) -> Layout:
    if request.frame is not None or request.all_frames:
        return "frames"
    return "scenes" if carries_nodes and not request.per_actor else "nodes"


def _split_scene(number: int, scene: ExchangeScene, layout: Layout, frame: int | None) -> Iterator[_Part]:
    """The files of a chunk, made one after the other: posed scenes are as large as the scene itself."""
    if layout == "scenes":
        yield _Part(f"chunk-{number}", scene)
    elif layout == "nodes":
        stems = _choose_stems([node.name for node in scene.nodes])
        for node, stem in zip(scene.nodes, stems, strict=True):
            yield _Part(f"chunk-{number}/{stem}", make_resting_scene(node.cloud), node=node.name)
    else:
        for index, at in enumerate(scene.frames):
            if frame is None or frame == at:
                posed = make_resting_scene(pose_scene(scene, index))
                yield _Part(f"chunk-{number}/frame-{at:06d}", posed, frame=at)


def _choose_stems(names: Sequence[str]) -> list[str]:
    """Names of files for nodes: those of imported scenes are whatever somebody else's file says."""
    stems: list[str] = []
    taken: set[str] = set()
    for name in names:
        base = re.sub(r"[^\w+=-]+", "-", name).strip("-")[:_STEM_CHARACTERS] or "node"
        stem = base
        number = 2
        # File systems may take names for one that differ in case alone.
        while stem.casefold() in taken:
            stem = f"{base}-{number}"
            number += 1
        taken.add(stem.casefold())
        stems.append(stem)
    return stems


def _check_found(entries: Sequence[ChunkEntry], request: ExportRequest, numbers: Sequence[int]) -> None:
    if not entries:
        raise InputError(
            f"none of the chunks {', '.join(map(str, numbers))} has frame {request.frame}",
            remedy="Give another --frame, or leave out --chunks.",
            frame=request.frame,
        )
    if request.per_actor and not any(entry.nodes for entry in entries):
        raise InputError("the scene has no actors", remedy="Leave out --per-actor.")
    if request.all_frames and not any(entry.posed for entry in entries):
        raise InputError("the scene has no frames: nothing in it moves", remedy="Leave out --all-frames.")


def _name_chunks(chunks_by_loss: Mapping[str, Sequence[int]], chunk_count: int) -> tuple[str, ...]:
    """Sentences that hold for all chunks as they are, and others with the chunks that they hold for."""
    return tuple(
        loss if len(chunks) == chunk_count else f"Chunk {', '.join(map(str, chunks))}: {loss}"
        for loss, chunks in chunks_by_loss.items()
    )


def _describe_layout(layout: Layout, entries: Sequence[ChunkEntry]) -> tuple[str, ...]:
    moves = any(node.motion is not None for entry in entries for node in entry.nodes)
    if not moves or layout == "scenes":
        return ()
    return (_POSED_FILES if layout == "frames" else _RESTING_FILES,)
