"""The methods that tables compare: registry entries, each a few settings over a preset and the stage where it ends.

A method of one's own is a YAML file::

    name: GNet, 24 iterations
    settings: [gnet.iterations=24]
    end: gnet                        # or enet (the default), or fnet: a fixer, for table 3
    note: what the reader should know
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args

import yaml

from flows.configuration import load_configuration
from genre_tasks.config import PipelineConfig
from genre_tasks.errors import ConfigError, InputError

End = Literal["gnet", "enet", "fnet"]
PER_SCENE = ("standard_3dgs", "street_gs")
_REFERENCE = re.compile(r"\{([a-z_.]+)\}")


@dataclass(frozen=True)
class Slot:
    """Weights that may be given by path: the setting that takes them, and the inputs that a fixer's must have."""

    name: str
    key: str
    about: str
    inputs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Method:
    """A row's recipe.

    ``settings``: ``section.key=value`` over everything else; ``{section.key}`` in one is the value that the
    configuration has by then. ``end``: the stage whose scene (``fnet``: whose images) is the result. ``slot`` names
    weights that the user may give; with ``needs_weights`` the method cannot do without, else ``stand_in`` says what is
    in their place.
    """

    name: str
    settings: tuple[str, ...]
    end: End = "enet"
    note: str = ""
    slot: str = ""
    needs_weights: bool = False
    stand_in: str = ""

    def configuration(self, preset: str, settings: Sequence[str]) -> PipelineConfig:
        """The preset, ``settings``, then the method's.

        What is set of per-scene training is the preset's where nothing is trained per scene, so that tables of other
        lengths share the stages of GNet. Raises ``ConfigError`` for a setting that is not allowed.
        """
        taken = list(settings)
        for setting in self.settings:
            taken.append(_filled(setting, preset, taken))
        config = load_configuration(preset, settings=taken)
        if config.gnet.method in PER_SCENE:
            return config
        gnet = config.gnet.model_copy(update={"per_scene": load_configuration(preset).gnet.per_scene})
        return config.model_copy(update={"gnet": gnet})

    def given(self, weights: Mapping[str, str]) -> Method:
        """With the weights that the user gave, and a note that says so, or what stands in for them."""
        if not self.slot:
            return self
        if self.slot not in weights:
            return replace(self, note=" ".join(part for part in (self.note, self.stand_in) if part))
        path = weights[self.slot]
        note = " ".join(part for part in (self.note, f"Weights given: {Path(path).name}.") if part)
        setting = f"{SLOTS[self.slot].key}={json.dumps(path)}"
        return replace(self, settings=(*self.settings, setting), note=note, slot="", needs_weights=False)


SLOTS: Mapping[str, Slot] = {
    slot.name: slot
    for slot in (
        Slot("difix", "fnet.weights", "a fixer trained with render and reference", ("render", "reference")),
        Slot("streetcrafter", "fnet.weights", "a fixer trained with reference and lidar", ("reference", "lidar")),
        Slot("enet-g3r", "enet.weights", "an ENet fine-tuned on scenes of G3R"),
    )
}
"""What ``--weights NAME=PATH`` takes."""

_AS_PUBLISHED = ("effects.rolling_shutter=off", "effects.exposure=off", "effects.anti_aliasing=off")
_DISTILLED = (
    "enet.method=adam",
    "enet.iterations=480",
    "enet.views_per_iteration=3",
    "enet.novel_views_per_iteration=3",
    "enet.adam.learning_rates={means: 0.05, log_scales: 0.05, quats: 0.0125, logit_opacities: 0.075, colors: 0.005}",
    "enet.adam.schedule=constant",
    "enet.loss.perceptual=0",
    "enet.split_fraction=0",
)
"""Per-scene distillation: the variant of tuned Adam that ``genre bench optimiser`` found to distil best (3 + 3 views an
iteration at half of the rates, no perceptual term), long enough to settle."""
_LEARNED = ("gnet.method=learned", "enet.method=learned")
_STREET_GS = ("gnet.method=street_gs", *_AS_PUBLISHED)
_ONE_SHOT = "Distilled by Adam, 480 iterations of 3 + 3 views; once, at 3 m, not progressively."

BUILT_IN: Mapping[str, Method] = {
    "3dgs": Method(
        "3DGS",
        ("gnet.method=standard_3dgs", *_AS_PUBLISHED),
        "gnet",
        "Per scene, everything static but the distant shell; no rolling shutter, exposure or anti-aliasing.",
    ),
    "streetgs": Method(
        "StreetGS-style",
        _STREET_GS,
        "gnet",
        "Per scene with actors in their boxes; no rolling shutter, exposure or anti-aliasing; without Street "
        "Gaussians' sky cubemap, tracking, semantics and Fourier colours.",
    ),
    "splatad": Method(
        "SplatAD-style",
        ("gnet.method=street_gs", "gnet.per_scene.depth=0.01", "effects.anti_aliasing=off"),
        "gnet",
        "StreetGS-style with rolling shutter and exposure where the chunk's plan has them and a LiDAR depth term; "
        "without SplatAD's decoder of features, LiDAR rendering and learned offsets of poses.",
    ),
    "g3r": Method(
        "G3R-style",
        ("gnet.method=g3r",),
        "gnet",
        "GNet's network trained on recorded views alone (λ_novel = 0), with weights of its own.",
    ),
    "gnet": Method("GNet", _LEARNED, "gnet"),
    "streetcrafter": Method(
        "StreetCrafter-style",
        (*_STREET_GS, *_DISTILLED),
        "enet",
        f"StreetGS-style scene → novel views → fixer → per-scene distillation. {_ONE_SHOT}",
        slot="streetcrafter",
        stand_in="No fixer with StreetCrafter's inputs (reference + LiDAR) is shipped: FNet with all inputs "
        "stands in, so that this row and Difix3D-style are one recipe.",
    ),
    "difix": Method(
        "Difix3D-style",
        (*_STREET_GS, *_DISTILLED),
        "enet",
        f"StreetGS-style scene → novel views → fixer → per-scene distillation. {_ONE_SHOT}",
        slot="difix",
        stand_in="No fixer with Difix3D's inputs (render + reference) is shipped: FNet with all inputs stands in.",
    ),
    "genre+": Method("GenRe+", _LEARNED, "enet", "GNet → FNet → ENet, as the preset has them."),
    "3dgs+genre": Method(
        "3DGS + GenRe",
        (*_LEARNED, "gnet.method=standard_3dgs", *_AS_PUBLISHED),
        "enet",
        "The shipped ENet, which was trained on scenes of GNet and of tuned Adam, not on 3DGS's as in the paper.",
    ),
    "g3r+genre": Method(
        "G3R-style + GenRe (zero-shot)",
        (*_LEARNED, "gnet.method=g3r"),
        "enet",
        "The shipped ENet, which was trained on scenes of GNet and of tuned Adam and never saw G3R's.",
    ),
    "g3r+genre-tuned": Method(
        "G3R-style + GenRe (fine-tuned)",
        (*_LEARNED, "gnet.method=g3r", "enet.learning_rates=null"),
        "enet",
        slot="enet-g3r",
        needs_weights=True,
    ),
    "gnet-gnet": Method(
        "GNet → FNet → GNet",
        (
            *_LEARNED,
            "enet.weights=builtin:gnet",
            "enet.learning_rates=null",
            "enet.iterations={gnet.iterations}",
            "enet.views_per_iteration={gnet.views_per_iteration}",
            "enet.novel_views_per_iteration={gnet.views_per_iteration}",
        ),
        "enet",
        "ENet's stage and loss with GNet's weights, its number of iterations, and its views of each kind.",
    ),
    "gnet-enet": Method("GNet → FNet → ENet", _LEARNED, "enet", "As the preset has them."),
    "fixer-streetcrafter": Method(
        "StreetCrafter-V's inputs",
        _LEARNED,
        "fnet",
        slot="streetcrafter",
        needs_weights=True,
    ),
    "fixer-difix": Method("Difix3D's inputs", _LEARNED, "fnet", slot="difix", needs_weights=True),
    "fnet": Method("FNet", _LEARNED, "fnet"),
}
"""By the name that table layouts use."""


def read_method(file: Path, preset: str, settings: Sequence[str] = ()) -> Method:
    """A method of the user's own; its settings are checked on the preset and ``settings``.

    Raises ``ConfigError`` naming the file: it is not there, is no such YAML, names a stage that is no end, a built-in
    method's name, or a setting that is not allowed.
    """
    values = _read(file)
    known = ("name", "settings", "end", "note")
    for key in values:
        if key not in known:
            raise ConfigError(
                f"a method has no {key!r}", remedy=f"{near(key, known)}Known: name, settings, end, note.", file=file
            )
    name, own, end = values.get("name"), values.get("settings", []), values.get("end", "enet")
    if not isinstance(name, str) or not name.strip() or "|" in name:
        raise ConfigError("the method has no name", remedy="Write `name: …`, a line without |.", file=file)
    if name in {m.name for m in BUILT_IN.values()}:
        raise ConfigError(f"a built-in method is called {name!r}", remedy="Give yours another name.", file=file)
    if not isinstance(own, list) or not all(isinstance(s, str) for s in own):
        raise ConfigError("settings is no list of strings", remedy="Write `settings: [gnet.iterations=24]`.", file=file)
    if end not in get_args(End):
        raise ConfigError(f"no scene or image ends at {end!r}", remedy="Write `end: gnet`, enet or fnet.", file=file)
    method = Method(name.strip(), tuple(own), end, str(values.get("note", "")))
    try:
        method.configuration(preset, settings)
    except ConfigError as error:
        raise ConfigError(error.problem, remedy=error.remedy, file=file) from error
    return method


def read_weights(given: Sequence[str]) -> dict[str, str]:
    """``NAME=PATH`` strings as slot → path.

    Raises ``ConfigError`` for a name that is no slot, ``InputError`` for weights that are missing or, of a fixer, were
    trained with other inputs.
    """
    out = {}
    for text in given:
        name, equals, path = text.partition("=")
        if name not in SLOTS or not equals or not path:
            known = "; ".join(f"{slot.name}: {slot.about}" for slot in SLOTS.values())
            raise ConfigError(f"cannot read --weights {text!r}", remedy=f"{near(name, SLOTS)}Write NAME=PATH. {known}.")
        _check_weights(SLOTS[name], Path(path))
        out[name] = path
    return out


def near(word: str, known: Iterable[str]) -> str:
    """``Did you mean …? `` or nothing."""
    found = difflib.get_close_matches(word, list(known), n=1)
    return f"Did you mean {found[0]}? " if found else ""


def _check_weights(slot: Slot, path: Path) -> None:
    if not path.exists():
        raise InputError("no such weights", remedy=f"Check --weights {slot.name}=….", file=path)
    if not slot.inputs:
        return
    beside = path / "fnet.json" if path.is_dir() else path.with_suffix(".json")
    try:
        document = json.loads(beside.read_text(encoding="utf-8"))
        inputs = document["architecture"].get("inputs")  # without it: all of them
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise InputError(
            f"the fixer's inputs cannot be read: {error}", remedy="Give weights of `genre train fnet`.", file=beside
        ) from error
    if inputs is None or set(inputs) != set(slot.inputs):
        raise InputError(
            f"the fixer was trained with {', '.join(inputs or ('all inputs',))}",
            remedy=f"Give one trained by `genre train fnet --inputs {'+'.join(slot.inputs)}`.",
            file=path,
        )


def _filled(setting: str, preset: str, before: Sequence[str]) -> str:
    """``{section.key}`` replaced by what the configuration so far says."""
    if not _REFERENCE.search(setting):
        return setting
    values: Any = load_configuration(preset, settings=before)

    def value(match: re.Match[str]) -> str:
        found = values
        for part in match[1].split("."):
            if not hasattr(found, part):
                raise ConfigError(
                    f"there is no configuration key {match[1]!r}", remedy=f"Mend the setting {setting!r} of the method."
                )
            found = getattr(found, part)
        return json.dumps(found)

    return _REFERENCE.sub(value, setting)


def _read(file: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError("the method's file cannot be read", remedy="Check --method.", file=file) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"the file is not YAML: {error}", remedy="Mend the line it names.", file=file) from error
    if not isinstance(values, dict):
        raise ConfigError(
            "expected name, settings, end", remedy="See flows/paper_tables/methods.py for one.", file=file
        )
    return values
