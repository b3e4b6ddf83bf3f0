"""Tables and pictures of the page on accuracy against time, from the tables of sweeps that ship with presets.

python docs/cost_tables.py    # draws docs/images/cost-PRESET.png
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from flows.budget.cost_table import find_shipped_table  # after the path is set
from flows.cost_sweep.page import INCLUDED, render_accuracy, render_seconds
from flows.cost_sweep.parquet import read_settings
from flows.cost_sweep.plot import draw_sweep
from flows.cost_sweep.summary import MEASURES, Measure, SettingSummary

PRESETS = ("small", "fine", "hd")
_FACTS = ("command", "logs", "seeds", "machine", "commit", "date")
_COLOURS_OF_A_PICTURE = 32


def _sweep(preset: str) -> tuple[list[SettingSummary], Measure, dict[str, str]]:
    """The settings of the preset's sweep, what they are compared by beside the path, and what was measured."""
    summaries, facts = read_settings(find_shipped_table(preset))
    return summaries, next(m for m in MEASURES if m.name == facts["judged"]), facts


def included() -> str:
    """What seconds and spreads are of."""
    return f"{INCLUDED}\n"


def accuracy(preset: str) -> str:
    """What was measured, and accuracy and costs of every setting."""
    summaries, novel_measure, facts = _sweep(preset)
    lines = [f"* {name}: {f'`{facts[name]}`' if name == 'command' else facts[name]}" for name in _FACTS]
    return "\n".join([*lines, "", render_accuracy(summaries, novel_measure)])


def seconds(preset: str) -> str:
    """Seconds of every stage with every setting."""
    return render_seconds(_sweep(preset)[0])


def draw(preset: str, path: Path) -> None:
    """Draws accuracy against seconds.

    Args:
        preset: whose sweep.
        path: the PNG file to write.
    """
    summaries, novel_measure, facts = _sweep(preset)
    picture = Image.fromarray(draw_sweep(summaries, novel_measure, f"{facts['preset']}: {facts['logs']}"))
    # Lines and points need few colours, and the file is a third as large with a palette.
    picture.quantize(_COLOURS_OF_A_PICTURE, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    for name in PRESETS:
        draw(name, ROOT / "docs" / "images" / f"cost-{name}.png")
