"""The weights of FID's and LPIPS's networks, and what can be checked of them without torch."""

from __future__ import annotations

import zipfile
from pathlib import Path

from genre_tasks.config import EvaluateConfig
from genre_tasks.errors import InputError
from genre_tasks.metrics.lpips_weights import LPIPS_FILES, check_lpips_weights

NETWORK_ARGUMENTS = {"inception": "return_features", "lpips": "return_lpips"}
"""An argument of each network's forward, which tells it from other networks; by the setting that names its file."""


def check_evaluation_networks(config: EvaluateConfig) -> list[Path]:
    """Checks the files of the networks that evaluation will load.

    Args:
        config: names them, or none.

    Returns:
        The files.

    Raises:
        InputError: a file is missing or unreadable, or holds another network; or weights are not installed.
    """
    found = find_network_files(config)
    for name, file in found.items():
        check_network_file(file, NETWORK_ARGUMENTS[name], f"evaluate.{name}")
    files = list(found.values())
    if config.lpips is not None and config.lpips in LPIPS_FILES:
        files.append(check_lpips_weights(config.lpips))
    return files


def find_network_files(config: EvaluateConfig) -> dict[str, Path]:
    """Finds the settings of evaluation that name a file of the user's.

    Args:
        config: names networks, or none.

    Returns:
        The file by the setting's name; a network whose weights come with a package is left out.

    >>> find_network_files(EvaluateConfig(inception="inception.pt", lpips="alex"))
    {'inception': PosixPath('inception.pt')}
    """
    settings = {name: getattr(config, name) for name in NETWORK_ARGUMENTS}
    # The weights of a package are pinned by the code, which is part of every key: their bytes need no digest there.
    return {
        name: Path(setting) for name, setting in settings.items() if setting is not None and setting not in LPIPS_FILES
    }


def describe_network_remedy(argument: str, key: str) -> str:
    """Words what to give in the place of a file that is no such network.

    Args:
        argument: of the network's forward.
        key: the setting that named the file.

    >>> describe_network_remedy("return_features", "evaluate.inception")
    'Give by evaluate.inception a TorchScript network whose forward takes return_features.'
    """
    # A slip such as `vgg16` is read as a file's name.
    names = f"one of {', '.join(LPIPS_FILES)}, or " if key == "evaluate.lpips" else ""
    return f"Give by {key} {names}a TorchScript network whose forward takes {argument}."


def check_network_file(file: Path, argument: str, key: str) -> None:
    """Checks that a file is a TorchScript network with an argument of that name, by the code that it holds.

    Args:
        file: the file.
        argument: of the network's forward.
        key: the setting that named the file, for errors.

    Raises:
        InputError: the file is missing, unreadable, or no such network.
    """
    remedy = describe_network_remedy(argument, key)
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
