"""The files of FID's and LPIPS's networks, and what can be checked of them without torch."""

from __future__ import annotations

import zipfile
from pathlib import Path

from genre_tasks.config import EvaluateConfig
from genre_tasks.errors import InputError

NETWORK_ARGUMENTS = {"inception": "return_features", "lpips": "return_lpips"}
"""An argument of each network's forward, which tells it from other networks; by the setting that names its file."""


def check_evaluation_networks(config: EvaluateConfig) -> list[Path]:
    """Checks the files of the networks that evaluation will load.

    Args:
        config: names them, or none.

    Returns:
        The files.

    Raises:
        InputError: a file is missing or unreadable, or holds another network.
    """
    files = {name: getattr(config, name) for name in NETWORK_ARGUMENTS}
    found = [(name, Path(file)) for name, file in files.items() if file is not None]
    for name, file in found:
        check_network_file(file, NETWORK_ARGUMENTS[name], f"evaluate.{name}")
    return [file for _, file in found]


def check_network_file(file: Path, argument: str, key: str) -> None:
    """Checks that a file is a TorchScript network with an argument of that name, by the code that it holds.

    Args:
        file: the file.
        argument: of the network's forward.
        key: the setting that named the file, for errors.

    Raises:
        InputError: the file is missing, unreadable, or no such network.
    """
    remedy = f"Give by {key} a TorchScript network whose forward takes {argument}."
    if not file.is_file():
        raise InputError("no such file", remedy=remedy, file=file)
    try:
        # TorchScript is a ZIP archive with the network's code as text. Other files of torch hold no code.
        with zipfile.ZipFile(file) as archive:
            names = [name for name in archive.namelist() if name.endswith(".py")]
            is_network = any(argument.encode() in archive.read(name) for name in names)
    except (OSError, zipfile.BadZipFile, ValueError) as error:
        raise InputError(f"the file is no TorchScript: {error}", remedy=remedy, file=file) from error
    if not names:
        raise InputError("the file is no TorchScript: it holds no code", remedy=remedy, file=file)
    if not is_network:
        raise InputError(f"the network's forward does not take {argument}", remedy=remedy, file=file)
