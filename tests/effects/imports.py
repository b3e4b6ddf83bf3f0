"""Whether a piece of code gets along without the effects' modules."""

from __future__ import annotations

import subprocess
import sys


def assert_imports_no_effect(code: str) -> None:
    """Runs it in a fresh interpreter; its own assertions count too."""
    after = (
        "\nimport sys\n"
        "from genre_tasks.effects.plan import EFFECT_NAMES\n"
        "loaded = [n for n in EFFECT_NAMES if f'genre_tasks.effects.{n}' in sys.modules]\n"
        "loaded += [n for n in sys.modules if n.endswith(('.gloss', '.harmonics'))]\n"
        "assert not loaded, loaded\n"
    )
    done = subprocess.run([sys.executable, "-c", code + after], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
