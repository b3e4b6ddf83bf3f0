"""The format of OpenUSD: packages and layers of fields of Gaussians with moving actors."""

from __future__ import annotations

import shutil
from pathlib import Path

from pxr import Tf

from genre_tasks.errors import InputError
from genre_tasks.exchange.checks import check_finite_cloud, measure_file
from genre_tasks.exchange.types import ExchangeScene
from genre_tasks.exchange.usd.package import extract_layers, write_package
from genre_tasks.exchange.usd.stage_process import run_stage_dump
from genre_tasks.exchange.usd.stage_scene import make_scene
from genre_tasks.exchange.usd.stage_writer import write_stage
from genre_tasks.temporary_names import temporary_folder

# Python's zipfile writes Zip64 headers from here on, which OpenUSD does not read; a MiB is for what is no array.
_MOST_LAYER_BYTES = int((2**31 - 1) / 1.05) - 2**20
"""A package's member stays below 1.9 GiB."""

_LAYER_NAME = "scene"


class UsdFormat:
    """USDZ packages and, by the file's name, layers of text (``.usda``) and of bytes (``.usdc``)."""

    name = "usdz"
    suffixes = (".usdz", ".usdc", ".usda", ".usd")
    can_write = True
    carries_nodes = True

    def read(self, path: Path) -> ExchangeScene:
        """Reads a file: see :meth:`genre_tasks.exchange.types.ExchangeFormat.read`.

        Returns:
            The scene.

        Raises:
            InputError: the file is damaged, or it names other files.
        """
        measure_file(path)
        with temporary_folder() as folder:
            layers = folder / "layers"
            layers.mkdir()
            layer = _copy_layers(path, layers)
            return make_scene(*run_stage_dump(layer, folder, path), path)

    def write(self, path: Path, scene: ExchangeScene) -> None:
        """Writes a file: see :meth:`genre_tasks.exchange.types.ExchangeFormat.write`.

        Raises:
            InputError: a value is not finite, or the scene is too large for a package.
            OSError: the file cannot be written.
        """
        for node in scene.nodes:
            check_finite_cloud(path, node.cloud)
        suffix = path.suffix.lower()
        if suffix == ".usdz":
            # Before minutes of writing; the layer itself is judged as well.
            _check_size(sum(len(node.cloud) * (11 + 3 + node.cloud.sh_rest[:1].size) * 4 for node in scene.nodes), path)
        # Beside the target: moving it there must not copy it to another disk.
        with temporary_folder(path.parent) as folder:
            layer = folder / f"{_LAYER_NAME}{'.usdc' if suffix == '.usdz' else suffix}"
            try:
                write_stage(layer, scene, path)
            except Tf.ErrorException as error:
                # All values were checked: it is the disk, and OpenUSD keeps the number of the error to itself.
                raise OSError("OpenUSD cannot write the layer") from error
            if suffix == ".usdz":
                _check_size(layer.stat().st_size, path)
                write_package(path, layer)
            else:
                layer.replace(path)

    def describe_losses(self, scene: ExchangeScene) -> tuple[str, ...]:
        """Lists what a file cannot carry: see :meth:`genre_tasks.exchange.types.ExchangeFormat.describe_losses`.

        Returns:
            Sentences.
        """
        if any(node.cloud.antialiased for node in scene.nodes):
            return ("Programs other than GenRe do not know from the file that the scene needs anti-aliasing.",)
        return ()


USDZ = UsdFormat()


def _check_size(size: int, path: Path) -> None:
    if size > _MOST_LAYER_BYTES:
        raise InputError(
            f"the scene has about {size / 2**30:.1f} GiB, and a USDZ package takes less than 1.9",
            remedy="Export fewer Gaussians, one node at a time, or a .usdc layer.",
            file=path,
        )


def _copy_layers(path: Path, folder: Path) -> Path:
    """Puts a file's layers alone into a folder; what is beside the file cannot be read from there."""
    if path.suffix.lower() == ".usdz":
        return extract_layers(path, folder)
    layer = folder / f"{_LAYER_NAME}{path.suffix.lower()}"
    shutil.copyfile(path, layer)
    return layer
