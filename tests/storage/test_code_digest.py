"""The code digest: the same for the same code wherever it lies, another for other code, and cheap."""

from __future__ import annotations

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from genre_tasks.code_closure import digest_modules, find_module_file, import_closure
from genre_tasks.errors import ConfigError
from genre_tasks.source_code import CPP_SUFFIXES
from storage import code_digest as module
from storage.code_digest import code_digest, public_version

ROOT = Path(__file__).resolve().parents[2]
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
    "render/api.py": 'import torch\n\nKERNEL = ("kernel.cpp", "api.py")\n\n\ndef draw(x):\n    return x\n',
    "render/lazy.py": "Y = 2\n",
    "render/kernel.cpp": (
        '// a kernel\n#include "../scene/shared.h"\nint f() { return 1; /* one */ } const char *s = "// no comment";\n'
    ),
    "scene/shared.h": "int shared();  // for kernels\n",
    "optimiser/__init__.py": "",
    "optimiser/loss.py": "from genre_tasks.scene import graph\nSOURCES = ['image_loss.cpp']\n",
    "optimiser/image_loss.cpp": "int g() { return 3; }\n",
    "cycle.py": "import genre_tasks.stages.gnet\n",
}
GNET, LOSS = "genre_tasks.stages.gnet", "genre_tasks.optimiser.loss"


def write_package(root: Path, changed: dict[str, str]) -> Path:
    for path, text in (TREE | changed).items():
        (root / "genre_tasks" / path).parent.mkdir(parents=True, exist_ok=True)
        (root / "genre_tasks" / path).write_text(text)
    return root


@pytest.fixture
def digest_with(tmp_path: Path):
    """Digest of the tree with some files replaced; each in a folder of its own."""

    def digest(name: str = GNET, also: tuple[str, ...] = (), changed: dict[str, str] | None = None) -> str:
        root = write_package(tmp_path / str(len(list(tmp_path.iterdir()))), changed or {})
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
        ("scene/shared.h", "// for kernels", ""),
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
        ("scene/shared.h", "int shared", "long shared"),
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
def test_a_kernel_counts_only_with_modules_that_name_it(
    digest_with, kernel: dict[str, str], user: str, others: tuple[str]
) -> None:
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
    closure = import_closure("genre_tasks.scene.reconstruction", (), ROOT)
    assert {"genre_tasks", "genre_tasks.scene.graph", "genre_tasks.logs.types"} <= set(closure.modules)
    assert "genre_tasks.config" not in closure.modules and {"torch", "numpy", "kornia"} <= closure.packages


def test_every_kernel_of_the_real_package_counts() -> None:
    tracked = {p for p in (ROOT / "genre_tasks").rglob("[a-z]*") if p.suffix in CPP_SUFFIXES}
    assert ROOT / "genre_tasks/losses/image_loss.cpp" in tracked
    assert set(import_closure("genre_tasks.stages.gnet", (), ROOT).cpp_files) == tracked


def test_every_package_that_stages_import_is_known() -> None:
    stages = [f"genre_tasks.stages.{path.stem}" for path in (ROOT / "genre_tasks/stages").glob("[a-z]*.py")]
    readers = ["genre_tasks.logs.pandaset.reader", "genre_tasks.logs.synthetic.log"]
    packages = import_closure("genre_tasks", [*stages, *readers], ROOT).packages - sys.stdlib_module_names
    # These check and store values, find files and ask for processes; they compute none.
    assert packages - {"pydantic", "safetensors", "huggingface_hub", "psutil"} <= set(module.NUMERIC_PACKAGES)


def test_a_benchmark_follows_its_own_package_too_and_a_stage_does_not(tmp_path: Path) -> None:
    root = write_package(tmp_path, {})
    (root / "benchmarks").mkdir()
    (root / "benchmarks/__init__.py").touch()
    (root / "benchmarks/speed.py").write_text("from benchmarks.scenes import X\n")
    (root / "benchmarks/scenes.py").write_text("from genre_tasks.scene.graph import LIMIT as X\n")
    (root / "genre_tasks/render/api.py").write_text("import benchmarks.scenes\n")
    followed = import_closure("benchmarks.speed", (), root).modules
    assert {"benchmarks.scenes", "genre_tasks.scene.graph"} <= followed.keys()
    of_stage = import_closure("genre_tasks.render.api", (), root)
    assert "benchmarks.scenes" not in of_stage.modules and "benchmarks" in of_stage.packages


LITTER = (
    ".DS_Store",
    "._gnet.py",
    "._kernel.cpp",
    "Thumbs.db",
    "desktop.ini",
    ".ipynb_checkpoints/gnet-checkpoint.py",
    "__pycache__/gnet.cpython-313.pyc",
    "__pycache__/gnet.py",
    "gnet (copy).py",
    "gnet_old.py",
    "kernel (copy).cpp",
    "kernel.cpp~",
    "kernel_avx2.so",
    ".gnet.py.swp",
)


def test_litter_changes_nothing(digest_with, tmp_path: Path) -> None:
    """Report: tuist/tuist#8842 (.DS_Store changes the hash of a folder of sources)."""
    # No text, as the files of an operating system are not.
    litter = {f"{room}/{name}": "\0\x05\x16\x07" for room in ("stages", "render", ".") for name in LITTER}
    assert digest_with() == digest_with(changed=litter)
    assert digest_with() == digest_with(changed={"stages/gnet_old.py": "X = 1\n"})
    locked = write_package(tmp_path / "locked", {})
    # An editor's lock is a link to nothing.
    (locked / "genre_tasks/render/.#kernel.cpp").symlink_to("me@here.42")
    (locked / "genre_tasks/stages/gnet.py").chmod(0o755)
    assert digest_with() == code_digest(GNET, (), locked)


def test_modules_of_a_package_have_digests_without_their_comments(tmp_path: Path) -> None:
    """Report: taikinman/imker#31 (comments and docstrings change a task's hash)."""
    comment = {"render/api.py": TREE["render/api.py"] + "# why\n", "render/._api.py": "\0"}
    code = {"render/api.py": TREE["render/api.py"] + "X = 1\n"}
    roots = [write_package(tmp_path / str(k), changed) for k, changed in enumerate(({}, comment, code))]
    plain, commented, extended = (digest_modules("genre_tasks.render.api", root) for root in roots)
    assert [name for name, _ in plain] == ["genre_tasks.render", "genre_tasks.render.api"]
    assert plain == commented != extended


def test_a_class_is_no_module_where_the_disk_ignores_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "genre_tasks").mkdir()
    (tmp_path / "genre_tasks/graph.py").touch()
    # As on such a disk, every spelling of a file that is there names it.
    monkeypatch.setattr(Path, "is_file", lambda path: path.name.lower() in {p.name for p in path.parent.iterdir()})
    assert find_module_file("genre_tasks.graph", tmp_path) == tmp_path / "genre_tasks/graph.py"
    assert find_module_file("genre_tasks.Graph", tmp_path) is None


@pytest.mark.parametrize(
    ("version", "public"),
    [
        ("2.13.0+cpu", "2.13.0"),
        ("2.13.0+cu130.with.pypi.cudnn", "2.13.0"),
        ("2.13.0", "2.13.0"),
        ("2.13.0a0+git1234", "2.13.0a0"),
        ("1!2.0.post1.dev3+local-1", "1!2.0.post1.dev3"),
    ],
)
def test_a_local_label_is_no_part_of_a_version(
    version: str, public: str, digest_with, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Report: pytorch/TensorRT#2315 (2.1.0+cu118 is not taken for 2.1.0)."""
    assert public_version(version) == public
    digests = []
    for installed in (version, public, "2.12.0"):
        monkeypatch.setattr(metadata, "version", lambda distribution, installed=installed: installed)
        digests.append(digest_with())
    assert digests[0] == digests[1] != digests[2]


def test_keys_do_not_pay_for_torch() -> None:
    code = (
        "import sys; import storage.local, storage.manifest, storage.address, storage.keys, storage.store\n"
        "from storage.code_digest import code_digest; code_digest('genre_tasks.scene.reconstruction')\n"
        "slow = {'torch', 'numpy', 'pyarrow', 'OpenEXR', 'kornia', 'prefect', 'genre_tasks.scene'} & set(sys.modules)\n"
        "assert not slow, slow"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT, timeout=60)
