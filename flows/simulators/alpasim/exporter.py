"""``genre export --format alpasim``: the scene bundle of a run in a folder of exports."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from flows.exchange.export_request import ExportRequest
from flows.exchange.stored_scenes import StoredScenes
from flows.simulators.alpasim.bundle import SUFFIX, write_alpasim_bundle
from genre_tasks.errors import ConfigError, InputError
from genre_tasks.exchange.scene_folder import SceneDocument, describe_chunk, digest_files, write_document
from genre_tasks.exchange.types import ExchangeScene, SplatCloud
from genre_tasks.progress import Progress

FORMAT = "alpasim"

_NO_GAUSSIANS = "The Gaussians are not in the bundle: genre serve --protocol alpasim renders them from the store."


class AlpasimExporter:
    """Writes one bundle for all chunks of a run; a ``SceneExporter``."""

    def check(self, request: ExportRequest) -> None:
        """Checks that the whole run is asked for.

        Args:
            request: for this format.

        Raises:
            ConfigError: single chunks, frames or actors are.
        """
        options = {
            "--chunks": request.chunks is not None,
            "--frame": request.frame is not None,
            "--all-frames": request.all_frames,
            "--per-actor": request.per_actor,
        }
        for name, is_chosen in options.items():
            if is_chosen:
                raise ConfigError(f"a bundle is of a whole run, and {name} is of a part", remedy=f"Leave out {name}.")

    def export(self, scenes: StoredScenes, request: ExportRequest, folder: Path, progress: Progress) -> dict[str, Any]:
        """Writes the bundle and ``scene.json``.

        Args:
            scenes: of a run.
            request: for this format.
            folder: empty.
            progress: called before the bundle.

        Returns:
            What :func:`write_alpasim_bundle` returns, and numbers of files and bytes.

        Raises:
            InputError: the scene was imported and has no log, or the run has one frame only.
        """
        if scenes.run_scenes is None:
            raise InputError(
                "an imported scene has no vehicle, cameras and times", remedy="Export a run.", file=request.scene
            )
        run = str(scenes.run_scenes.record["run"])
        progress(0, 1, f"{run}{SUFFIX}")
        report = write_alpasim_bundle(request.store, run, folder / f"{run}{SUFFIX}", request.stage)
        losses = [_NO_GAUSSIANS, *report["losses"]]
        files = digest_files(folder)
        chunks = [
            describe_chunk(number, _without_gaussians(scenes.load(number)), scenes.describe_chunk(number))
            for number in scenes.chunk_numbers
        ]
        document = SceneDocument(
            format=FORMAT,
            layout="scenes",
            source=scenes.describe(),
            chunks=tuple(chunks),
            losses=tuple(losses),
            files=files,
        )
        write_document(folder, document)
        return {
            **report,
            "gaussians": 0,
            "files": [file.path for file in files],
            "bytes": sum(file.size for file in files),
            "losses": losses,
        }


def _without_gaussians(scene: ExchangeScene) -> ExchangeScene:
    # What the files hold, and they hold no Gaussians.
    return replace(scene, nodes=tuple(replace(node, cloud=SplatCloud.empty()) for node in scene.nodes))


ALPASIM = AlpasimExporter()
