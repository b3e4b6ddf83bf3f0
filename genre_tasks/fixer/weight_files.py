"""The files of a fixer's weights, and what can be checked of them without torch."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from genre_tasks.config import FnetConfig
from genre_tasks.errors import InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.user_paths import expand_user_path
from genre_tasks.weight_files import read_tensor_shapes
from genre_tasks.weights import resolve_weights

REMEDY = "Give weights that `genre train fnet` wrote for this version, or leave `fnet.weights` at builtin."
_ADAPTERS_REMEDY = (
    "Train adapters first: `genre train fnet --preset paper --start FOLDER`. "
    "Then give their folder by `fnet.weights`, or set `fnet.model` to small."
)
WEIGHTS_FILE = "fnet.safetensors"
_BASE_FOLDERS = ("vae", "unet")


def find_fixer_weights(config: FnetConfig) -> Path:
    """Finds the file or folder of the weights that the configuration names.

    Args:
        config: with model and weights.

    Returns:
        A path that exists.

    Raises:
        InputError: it does not exist, or holds no trained adapters where the model is SD-Turbo.
    """
    if config.model == "sd-turbo":
        return _find_adapters(config.weights)
    return resolve_weights("fnet", config.weights)


def _find_adapters(configured: str) -> Path:
    """Finds adapters on SD-Turbo: the only weights of that model that a run can take."""
    # SD-Turbo's weights are large and have a licence of their own.
    if configured.partition(":")[0] == "builtin":
        raise InputError("no weights of sd-turbo ship with the package", remedy=_ADAPTERS_REMEDY, stage="fnet")
    path = expand_user_path(configured)
    # A hub id and SD-Turbo's own folder look like weights, and no other weights would help.
    if not path.exists() or (path.is_dir() and not (path / WEIGHTS_FILE).with_suffix(".json").is_file()):
        raise InputError("there are no adapters of sd-turbo", remedy=_ADAPTERS_REMEDY, file=path, stage="fnet")
    return path


def read_fixer_document(path: Path, model: str) -> dict[str, Any]:
    """Reads the JSON that describes a fixer.

    Args:
        path: of the weights' file; the JSON lies beside it.
        model: ``small`` or ``sd-turbo``, which the weights must be of.

    Returns:
        What the JSON holds.

    Raises:
        InputError: it is missing or unreadable, or is of the other model.
    """
    document = read_json_object(path.with_suffix(".json"), "configuration of the weights", REMEDY, stage="fnet")
    if document.get("model") != model:
        raise InputError(
            f"the weights are of the model {document.get('model')!r}, the configuration says {model!r}",
            remedy="Set `fnet.model` to the weights' model, or give other weights.",
            file=path,
            stage="fnet",
        )
    return document


def require_timestep(trained: object, configured: int) -> None:
    """Refuses weights of another timestep.

    Args:
        trained: the timestep of the weights.
        configured: the timestep that the fixer would run at.

    Raises:
        InputError: they differ.
    """
    # The network has learned the noise of one timestep; at another one its output is wrong without any error.
    if trained != configured:
        raise InputError(
            f"the weights were trained at timestep {trained}, configured is {configured}",
            remedy="Set `fnet.timestep` to the weights' timestep, or train others.",
            stage="fnet",
        )


def check_fixer_files(config: FnetConfig) -> Path:
    """Checks that a fixer's weights are there, complete and those of the configuration, as far as headers tell.

    Args:
        config: with model, weights and timestep.

    Returns:
        The file of the weights.

    Raises:
        InputError: a file, a package or SD-Turbo itself is missing, or the weights do not fit the configuration.
    """
    path, described = check_described_weights(find_fixer_weights(config), config.model)
    require_timestep(described.get("timestep", config.timestep), config.timestep)
    if config.model == "sd-turbo":
        # A base next to the weights moves with them; anything else is a hub id.
        check_sd_turbo(described.get("base"), path.parent)
    return path


def check_described_weights(found: Path, model: str) -> tuple[Path, dict[str, Any]]:
    """Checks that a file of weights is complete and described by the JSON beside it.

    Args:
        found: the file, or a folder that holds ``fnet.safetensors``.
        model: ``small`` or ``sd-turbo``, which the weights must be of.

    Returns:
        The file of the weights, and what the JSON says of their network.

    Raises:
        InputError: a file is missing, unreadable or of the other model.
    """
    path = found / WEIGHTS_FILE if found.is_dir() else found
    document = read_fixer_document(path, model)
    if not read_tensor_shapes(path, REMEDY, stage="fnet"):
        raise InputError("the file holds no weights", remedy=REMEDY, file=path, stage="fnet")
    described = document.get("architecture") if model == "small" else document
    if not isinstance(described, dict):
        raise InputError("the configuration of the weights has no architecture", remedy=REMEDY, file=path, stage="fnet")
    return path, described


def check_sd_turbo(base: object, folder: Path) -> None:
    """Checks what SD-Turbo's adapters need: their package, and SD-Turbo's own weights on this machine.

    Args:
        base: a folder, or a hub id.
        folder: that a relative path of ``base`` starts from.

    Raises:
        InputError: the package is not installed, or a part of SD-Turbo is missing.
    """
    if importlib.util.find_spec("peft") is None:
        raise InputError(
            "SD-Turbo's adapters need the package peft", remedy="Run `pip install 'genre[sd-turbo]'`.", stage="fnet"
        )
    if not isinstance(base, str) or not base:
        raise InputError("the weights do not name SD-Turbo's folder", remedy=REMEDY, file=folder, stage="fnet")
    local = folder / base
    if local.exists():
        missing = [name for name in _BASE_FOLDERS if not (local / name / "config.json").is_file()]
    else:
        missing = [name for name in _BASE_FOLDERS if not _is_downloaded(base, name)]
    # It would be downloaded when FNet begins, which is late for a machine without a network.
    if missing:
        raise InputError(
            f"SD-Turbo ({base}) is not on this machine: it has no {' and no '.join(missing)}",
            remedy=f"Download it once, e.g. by `hf download {base}`, or give a folder with vae and unet.",
            stage="fnet",
        )


def _is_downloaded(base: str, folder: str) -> bool:
    from huggingface_hub import try_to_load_from_cache
    from huggingface_hub.errors import HFValidationError

    try:
        return isinstance(try_to_load_from_cache(base, f"{folder}/config.json"), str)
    except HFValidationError:
        # It cannot be a hub id, as a path that does not exist.
        return False
