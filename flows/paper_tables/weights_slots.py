"""Weights that do not ship and that the user may give with ``--weights NAME=PATH``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from genre_tasks.errors import ConfigError, InputError
from genre_tasks.json_files import read_json_object
from genre_tasks.suggestions import did_you_mean
from genre_tasks.user_paths import expand_user_path


@dataclass(frozen=True)
class WeightsSlot:
    """A place for weights in a method.

    Attributes:
        name: what the user writes before ``=``.
        key: the configuration key that takes the path.
        about: what to give, for error messages.
        inputs: what a fixer's weights must have been trained with; empty for weights of another network.
    """

    name: str
    key: str
    about: str
    inputs: tuple[str, ...] = ()


SLOTS: Mapping[str, WeightsSlot] = {
    slot.name: slot
    for slot in (
        WeightsSlot("difix", "fnet.weights", "a fixer trained with render and reference", ("render", "reference")),
        WeightsSlot(
            "streetcrafter", "fnet.weights", "a fixer trained with reference and lidar", ("reference", "lidar")
        ),
        WeightsSlot("enet-g3r", "enet.weights", "an ENet fine-tuned on scenes of G3R"),
    )
}
"""The slots by name."""


def read_weights(options: Sequence[str]) -> dict[str, str]:
    """Reads the options ``--weights``.

    Args:
        options: ``NAME=PATH`` strings.

    Returns:
        Slot → path.

    Raises:
        ConfigError: a name is no slot.
        InputError: weights are missing, or a fixer's were trained with other inputs.

    >>> read_weights(["difx=fnet.safetensors"])
    Traceback (most recent call last):
    genre_tasks.errors.ConfigError: cannot read --weights 'difx=fnet.safetensors'. Did you mean 'difix'? …
    """
    weights = {}
    for option in options:
        name, equals, path = option.partition("=")
        if name not in SLOTS or not equals or not path:
            known = "; ".join(f"{slot.name}: {slot.about}" for slot in SLOTS.values())
            remedy = f"{did_you_mean(name, SLOTS)}Write NAME=PATH. {known}."
            raise ConfigError(f"cannot read --weights {option!r}", remedy=remedy)
        # Checked now, because the stage that loads them may run hours later.
        _check_weights(SLOTS[name], expand_user_path(path))
        weights[name] = path
    return weights


def _check_weights(slot: WeightsSlot, path: Path) -> None:
    if not path.exists():
        raise InputError("no such weights", remedy=f"Check --weights {slot.name}=….", file=path)
    # Weights of ENet all have the same inputs.
    if not slot.inputs:
        return
    inputs = _read_trained_inputs(path)
    # A fixer with other inputs would run, and the row's name would then be wrong.
    if inputs is None or set(inputs) != set(slot.inputs):
        raise InputError(
            f"the fixer was trained with {', '.join(inputs or ('all inputs',))}",
            remedy=f"Give one trained by `genre train fnet --inputs {'+'.join(slot.inputs)}`.",
            file=path,
        )


def _read_trained_inputs(path: Path) -> list[str] | None:
    """Reads which inputs a fixer was trained with from the JSON beside its weights; ``None`` stands for all."""
    file = path / "fnet.json" if path.is_dir() else path.with_suffix(".json")
    remedy = "Give weights of `genre train fnet`."
    architecture = read_json_object(file, "fixer's configuration", remedy).get("architecture")
    if not isinstance(architecture, dict):
        raise InputError("the fixer's configuration has no architecture", remedy=remedy, file=file)
    inputs: list[str] | None = architecture.get("inputs")
    if inputs is not None and not (isinstance(inputs, list) and all(isinstance(name, str) for name in inputs)):
        raise InputError("the fixer's configuration does not list its inputs", remedy=remedy, file=file)
    return inputs
