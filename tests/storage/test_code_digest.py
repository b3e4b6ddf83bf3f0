"""The code digest: blind to comments and docstrings, sharp for code, and cheap."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from genre_tasks.errors import ConfigError
from storage import code_digest as module
from storage.code_digest import code_digest, import_closure, strip_cpp_comments

TREE = {
    "__init__.py": '"""Package."""\n',
    "stages/__init__.py": "",
    "stages/gnet.py": (
        '"""Stage."""\nfrom genre_tasks.scene import graph\nimport json\n\n\ndef run(x):\n    """Doc."""\n'
        "    from ..render import draw  # lazily\n    return draw(graph.f(x))\n"
    ),
    "stages/other.py": "import kornia\nX = 1\n",
    "scene/__init__.py": "",
    "scene/graph.py": "import numpy as np\n\nLIMIT = 1\n'''About the limit.'''\n\n\ndef f(x):\n    return x + LIMIT\n",
    "render/__init__.py": "from .api import draw\n",
    "render/api.py": "import torch\n\n\ndef draw(x):\n    return x\n",
    "render/lazy.py": "Y = 2\n",
    "render/kernel.cpp": '// a kernel\nint f() { return 1; /* one */ } const char *s = "// no comment";\n',
    "optimiser/__init__.py": "",
    "optimiser/loss.py": "from genre_tasks.scene import graph\n",
    "optimiser/image_loss.cpp": "int g() { return 3; }\n",
    "cycle.py": "import genre_tasks.stages.gnet\n",
}
GNET, LOSS = "genre_tasks.stages.gnet", "genre_tasks.optimiser.loss"


@pytest.fixture
def digest_with(tmp_path: Path):
    """Digest of the tree with some files replaced; each in a folder of its own."""

    def digest(name: str = GNET, also: tuple[str, ...] = (), changed: dict[str, str] | None = None) -> str:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        for path, text in (TREE | (changed or {})).items():
            (root / "genre_tasks" / path).parent.mkdir(parents=True, exist_ok=True)
            (root / "genre_tasks" / path).write_text(text)
        return code_digest(name, also, root)

    return digest


def changed_line(path: str, old: str, new: str) -> dict[str, str]:
    assert old in TREE[path]
    return {path: TREE[path].replace(old, new)}


@pytest.mark.parametrize(
    ("path", "old", "new"),
    [
        ("stages/gnet.py", '"""Stage."""', '"""Another sentence."""'),
        ("stages/gnet.py", '    """Doc."""\n', ""),
        ("stages/gnet.py", "# lazily", "# because"),
        ("scene/graph.py", "'''About the limit.'''", "# nothing"),
        ("scene/graph.py", "x + LIMIT", "(x\n            + LIMIT)"),
        ("stages/other.py", "X = 1", "X = 2"),
        ("render/lazy.py", "Y = 2", "Y = 3"),
        ("render/kernel.cpp", "// a kernel", "// the kernel"),
        ("render/kernel.cpp", "/* one */", ""),
    ],
)
def test_what_changes_nothing_keeps_the_digest(digest_with, path: str, old: str, new: str) -> None:
    assert digest_with() == digest_with(changed=changed_line(path, old, new))


@pytest.mark.parametrize(
    ("path", "old", "new"),
    [
        ("stages/gnet.py", "graph.f(x)", "graph.f(x) + 1"),
        ("scene/graph.py", "LIMIT = 1", "LIMIT = 2"),
        ("render/api.py", "return x", "return -x"),
        ("render/__init__.py", "from .api import draw", "from .api import draw\nZ = 1"),
        ("render/kernel.cpp", "return 1", "return 2"),
        ("render/kernel.cpp", "// no comment", "// a comment"),
    ],
)
def test_a_changed_line_changes_the_digest(digest_with, path: str, old: str, new: str) -> None:
    assert digest_with() != digest_with(changed=changed_line(path, old, new))


def test_lazily_named_modules_count_when_they_are_named(digest_with) -> None:
    lazy = ("genre_tasks.render.lazy",)
    changed = changed_line("render/lazy.py", "Y = 2", "Y = 3")
    assert digest_with() != digest_with(also=lazy) != digest_with(also=lazy, changed=changed)


@pytest.mark.parametrize(
    ("kernel", "user", "others"),
    [
        (changed_line("render/kernel.cpp", "return 1", "return 2"), GNET, ("scene.graph", "optimiser.loss")),
        (changed_line("optimiser/image_loss.cpp", "3", "4"), LOSS, ("scene.graph", "render.api")),
    ],
)
def test_a_kernel_counts_only_with_its_room(digest_with, kernel: dict[str, str], user: str, others: tuple[str]) -> None:
    assert digest_with(user) != digest_with(user, changed=kernel)
    for other in others:
        assert digest_with(f"genre_tasks.{other}") == digest_with(f"genre_tasks.{other}", changed=kernel)


def test_versions_of_imported_packages_count(digest_with, monkeypatch: pytest.MonkeyPatch) -> None:
    before, other = digest_with(), digest_with("genre_tasks.stages.other")
    real = module._installed_version
    monkeypatch.setattr(module, "_installed_version", lambda name: "0" if name == "torch" else real(name))
    assert digest_with() != before and digest_with("genre_tasks.stages.other") == other


def test_cycles_end_and_unknown_modules_are_named(digest_with) -> None:
    changed = {"scene/graph.py": TREE["scene/graph.py"] + "import genre_tasks.cycle\n"}
    assert digest_with(changed=changed) != digest_with()
    with pytest.raises(ConfigError, match=r"no module 'genre_tasks\.stages\.gone'"):
        digest_with("genre_tasks.stages.gone")
    with pytest.raises(ConfigError, match="no module"):
        digest_with(also=("genre_tasks.gone",))


def test_closure_of_the_real_package() -> None:
    files, packages = import_closure("genre_tasks.scene.reconstruction", (), Path(module.__file__).parents[1])
    assert {"genre_tasks", "genre_tasks.scene.graph", "genre_tasks.logs.types"} <= set(files)
    assert "genre_tasks.config" not in files and {"torch", "numpy", "kornia"} <= packages


def test_every_kernel_of_the_real_package_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    covered: set[str] = set()
    monkeypatch.setattr(module, "_update", lambda digest, name, text: covered.add(name))
    module._digest_closure.__wrapped__("genre_tasks.stages.gnet", ("genre_tasks.render.cpu",), None)
    root = Path(module.__file__).parents[1]
    sources = {p.relative_to(root).as_posix() for p in (root / "genre_tasks").rglob("*") if p.suffix in (".cpp", ".h")}
    assert "genre_tasks/losses/image_loss.cpp" in sources and sources <= covered


def test_cpp_comments() -> None:
    assert strip_cpp_comments("int a; // x\n\n/* y\n z */ char c = '\"'; // \"\n") == "int a;\nchar c = '\"';"


def test_keys_do_not_pay_for_torch() -> None:
    code = (
        "import sys; import storage.local, storage.manifest, storage.address, storage.keys, storage.store\n"
        "from storage.code_digest import code_digest; code_digest('genre_tasks.scene.reconstruction')\n"
        "slow = {'torch', 'numpy', 'pyarrow', 'OpenEXR', 'kornia', 'prefect', 'genre_tasks.scene'} & set(sys.modules)\n"
        "assert not slow, slow"
    )
    root = Path(module.__file__).parents[1]
    subprocess.run([sys.executable, "-c", code], check=True, cwd=root, timeout=60)
