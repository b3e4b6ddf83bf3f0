"""What a layer may name: nothing outside of its file or package, and few parts twice."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pxr import Sdf

from genre_tasks.errors import InputError

_MAX_ARCS = 32
"""Arcs may repeat what they name, and arcs of arcs repeat it more often: a few are enough for a scene."""

_LIST_FIELDS = ("references", "payload", "inheritPaths", "specializes")


def check_layers(root: Path) -> None:
    """Checks all layers of a folder before OpenUSD composes them.

    Args:
        root: the layer that is shown; layers in its folder may be named by it.

    Raises:
        InputError: a layer names a file outside of the package, has clips, or repeats its parts too often.
        pxr.Tf.ErrorException: a layer is no layer.
    """
    arc_count = 0
    folder = root.parent
    todo = [root]
    visited = set()
    while todo:
        path = todo.pop()
        if path in visited:
            continue
        visited.add(path)
        layer = Sdf.Layer.FindOrOpen(str(path))
        if layer is None:
            raise InputError("the file is no layer of OpenUSD", remedy="Export the scene again.")
        named, arcs = _find_arcs(layer)
        arc_count += arcs
        if arc_count > _MAX_ARCS:
            raise InputError(
                f"the file composes more than {_MAX_ARCS} parts",
                remedy="Flatten it with `usdcat --flatten`, and give the result.",
            )
        todo.extend(_resolve(name, path, folder) for name in named)


def _find_arcs(layer: Any) -> tuple[list[str], int]:
    """Names of other files that a layer composes, and the number of its arcs inside of the package."""
    named = [str(name) for name in layer.subLayerPaths]
    arcs = len(named)

    def visit(path: Any) -> None:
        nonlocal arcs
        is_prim = path.IsPrimPath() or path.IsPrimVariantSelectionPath()
        spec = layer.GetPrimAtPath(path) if is_prim else None
        if spec is None:
            return
        if spec.HasInfo("clips") or spec.HasInfo("clipSets"):
            raise InputError(
                f"the prim {path} takes its values from other files (clips)",
                remedy="Flatten the scene with `usdcat --flatten`, and give the result.",
            )
        for field in _LIST_FIELDS:
            if spec.HasInfo(field):
                items = spec.GetInfo(field).GetAddedOrExplicitItems()
                arcs += len(items)
                named.extend(item.assetPath for item in items if getattr(item, "assetPath", ""))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return named, arcs


def _resolve(name: str, layer: Path, folder: Path) -> Path:
    # By the rules of paths alone: OpenUSD's own search would also look elsewhere.
    target = (layer.parent / name).resolve()
    is_local = target.is_relative_to(folder.resolve()) and target.suffix.lower() in (".usdc", ".usda", ".usd")
    if not is_local or not target.is_file() or Path(name).is_absolute():
        raise InputError(
            f"the file names another one, '{name}', which is not read",
            remedy="Flatten the scene with `usdcat --flatten`, and give the result.",
        )
    return target
