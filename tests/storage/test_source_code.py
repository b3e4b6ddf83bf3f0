"""Digests of source files: the same on every Python and after every formatter, another for other code."""

from __future__ import annotations

import ast
import hashlib
import shutil
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import pytest

from genre_tasks.source_code import digest_source, strip_cpp_comments, write_tree

ROOT = Path(__file__).resolve().parents[2]
SYNTAX = ROOT / "tests/data/python_syntax.txt"
# Computed on Python 3.11, 3.12, 3.13 and 3.14.
SYNTAX_SHA256 = "0118fc96576c5f0ba4dea84186fa9b2b3102b91c9482e80261847ffa354b9ab7"
KERNEL = ROOT / "genre_tasks/render/kernel/kernel.cpp"


def sha256(source: str | bytes) -> str:
    return hashlib.sha256(write_tree(ast.parse(source)).encode()).hexdigest()


def ruff_format(folder: Path, *settings: str) -> None:
    options = [part for setting in settings for part in ("--config", setting)]
    command = [sys.executable, "-m", "ruff", "format", "--isolated", "--no-cache", "-q", *options, str(folder)]
    subprocess.run(command, check=True, timeout=60)


def test_every_version_of_python_writes_the_same_tree() -> None:
    """Report: apache/buildstream#1988 (cache keys differ between Python 3.12 and 3.13); spack/spack#47217."""
    assert sha256(SYNTAX.read_bytes()) == SYNTAX_SHA256


_DIGESTS = """
import hashlib, pathlib, storage.code_digest as room
from genre_tasks.source_code import digest_source
# The other interpreter has no packages: their versions are taken to be equal.
room._installed_version = lambda distribution: "1"
stages = sorted(path.stem for path in pathlib.Path("genre_tasks/stages").glob("[a-z]*.py"))
digests = [room.code_digest(f"genre_tasks.stages.{stage}") for stage in stages]
digests.append(digest_source(pathlib.Path("tests/data/python_syntax.txt")))
print(hashlib.sha256("".join(digests).encode()).hexdigest())
"""


@cache
def run_python(interpreter: str | Path, code: str, option: str = "-B") -> str:
    # Without a cache, in which one interpreter would find what another one has read.
    environment = {"PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1", "GENRE_CACHE_DIR": "/dev/null"}
    command = [interpreter, option, "-c", code]
    run = subprocess.run(command, env=environment, cwd=ROOT, capture_output=True, text=True, timeout=60, check=False)
    # A launcher of another version manager may be there without its interpreter.
    return run.stdout


def test_an_interpreter_that_removes_docstrings_and_assertions_agrees() -> None:
    code = (
        "from pathlib import Path; from genre_tasks.source_code import digest_source; print(digest_source(Path('{}')))"
    )
    digests = {run_python(sys.executable, code.format(SYNTAX), option) for option in ("-O", "-OO", "-B")}
    assert digests == {f"{SYNTAX_SHA256}\n"}


@pytest.mark.parametrize("minor", range(12, 17))
def test_interpreters_that_are_installed_agree(minor: int) -> None:
    """Report: apache/buildstream#1988 (cache keys differ between Python 3.12 and 3.13)."""
    name = f"python3.{minor}"
    candidates = [shutil.which(name), *Path.home().glob(f".pyenv/versions/3.{minor}.*/bin/{name}")]
    found = next((path for path in candidates if path and run_python(path, "print(1)")), None)
    if found is None:
        pytest.skip(f"{name} is not installed")
    assert run_python(found, _DIGESTS) == run_python(sys.executable, _DIGESTS) != ""


def test_parts_of_f_strings_that_versions_divide_differently() -> None:
    """Report: spack/spack#47217 (f-strings made package hashes differ between versions)."""
    name = ast.FormattedValue(ast.Name("x"), -1, ast.JoinedStr([]))
    divided = [ast.Constant("a"), ast.Constant(""), ast.Constant("b"), name]
    joined = [ast.Constant("ab"), ast.FormattedValue(ast.Name("x"), -1, None)]
    assert write_tree(ast.JoinedStr(list(divided))) == write_tree(ast.JoinedStr(list(joined)))


@pytest.mark.parametrize(
    "settings",
    [
        ("line-length=40", 'format.quote-style="single"', "format.docstring-code-format=true"),
        ("line-length=320", "format.skip-magic-trailing-comma=true", 'format.line-ending="cr-lf"', "indent-width=2"),
        ("line-length=60", "format.preview=true", 'target-version="py313"'),
    ],
)
def test_a_formatter_changes_no_digest(tmp_path: Path, settings: tuple[str, ...]) -> None:
    """Report: taikinman/imker#31 (comments and docstrings change a task's hash)."""
    sources = [*(ROOT / "genre_tasks/logs").rglob("*.py"), *(ROOT / "genre_tasks/learned").rglob("*.py")]
    copies = {tmp_path / f"{k}.py": source for k, source in enumerate([SYNTAX, *sources])}
    for copy, source in copies.items():
        shutil.copy(source, copy)
    ruff_format(tmp_path, *settings)
    assert any(copy.read_bytes() != source.read_bytes() for copy, source in copies.items())
    for copy, source in copies.items():
        assert sha256(copy.read_bytes()) == sha256(source.read_bytes()), source


@pytest.mark.parametrize(
    "encoded",
    [
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: text.replace("\n", "\r").encode(),
        lambda text: text.encode("utf-8-sig"),
        lambda text: ("# coding: latin-1\n" + text).encode("latin-1"),
    ],
    ids=["CRLF", "CR", "byte order mark", "latin-1"],
)
def test_a_checkout_or_an_editor_changes_no_digest(tmp_path: Path, encoded) -> None:
    """Report: actions/runner#1246 (a checkout with CRLF has other hashes)."""
    text = 'A = """é\n\n  b"""  # why\n\n\ndef f():\n\tB = 1\n\treturn B\n'
    (tmp_path / "plain.py").write_bytes(text.encode())
    (tmp_path / "other.py").write_bytes(encoded(text))
    assert digest_source(tmp_path / "other.py") == digest_source(tmp_path / "plain.py")


DIFFERENT = (
    ("x = 1", "x = 1.0", "x = True", "x = '1'", "x = b'1'", "x = 1j", "x = -1", "x = None", "x = ...", "x = (1,)"),
    ("x = 'a'", "x = 'b'", "x = 'a '", "x = f'a{b}'", "x = f'{b}a'", "x = f'{b!r}a'", "x = f'{b:a}'", "x = f'{b=}'"),
    ("return", "return f''", "return None", "return ''", "yield", "yield from x"),
    ("f(a)", "f(*a)", "f(**a)", "f(a=a)", "f((a,))", "f([a])", "f(a)(a)", "(f, a)", "f[a]", "f.a"),
    ("{**a}", "{None: a}", "{a}", "{a: a}", "{'a': a}", "[a]"),
    ("def f(*, a, b=None): g", "def f(*, a=None, b): g", "def f(a, *, b=None): g", "def f(*, a, b: int = None): g"),
    ("def f(a, /): g", "def f(a): g", "async def f(a): g", "class f(a): g", "lambda a: g"),
    ("if a:\n  b\nc", "if a:\n  b\n  c", "if a:\n  b\nelse:\n  c", "while a:\n  b\nelse:\n  c", "if a:\n  pass\nb\nc"),
    ("a + b - c", "a + (b - c)", "a - b + c", "a + b", "a @ b", "a + +b"),
    ("a < b < c", "a < (b < c)", "(a < b) < c", "a < b and b < c"),
    ("import a", "import a as b", "from a import b", "from . import b", "from .. import b", "from .a import b"),
    ("x: int", "x: int = 1", "(x): int", "x = 1", "x += 1", "(x := 1)"),
    ("'doc' + a", "a", "a.b", "print('doc')"),
)


@pytest.mark.parametrize("sources", DIFFERENT)
def test_other_code_has_another_digest(sources: tuple[str, ...]) -> None:
    assert len({write_tree(ast.parse(source)) for source in sources}) == len(sources)


@pytest.mark.parametrize(
    "sources",
    [
        ("x = 'a' 'b'", 'x = ("a"\n  "b")', "x = 'ab' # why", "x = u'ab'", "x = '\\x61b'"),
        ("def f(a, b): pass", 'def f(\n  a,\n  b,\n):\n  """Doc."""', "def f(a, b):\n  'one'\n  'two'\n"),
        ("x = 0xFF + 1E3 + .5", "x = (0Xff\n + 1e3\n  + 0.50)", "x = 255 + 1_000.0 + 5e-1"),
        ("a; b", "a\n\n\nb", "a\n# why\nb\n"),
        ("x = f'{a}' f\"b\"", 'x = f"{ a }b"', "x = f'{a:}b'"),
    ],
)
def test_the_same_code_has_one_digest(sources: tuple[str, ...]) -> None:
    assert len({write_tree(ast.parse(source)) for source in sources}) == 1


def test_comments_of_cpp() -> None:
    text = "int a; // x\n\n/* y\n z */ char c = '\"'; // \"\n"
    assert strip_cpp_comments(text) == "int a;\nchar c = '\"';"
    assert strip_cpp_comments("// one \\\n two\nint a = 1'000; // it's /* here\nint b;") == "int a = 1'000;\nint b;"
    assert strip_cpp_comments("int /* a */ b;") == strip_cpp_comments("int /* a\n line */ b;") == "int b;"


def test_strings_of_cpp_keep_what_looks_like_a_comment() -> None:
    raw = 'auto s = u8R"x( // no\n\n   comment " )" )x";'
    assert strip_cpp_comments(f"/* c */ {raw} // c") == raw
    plain = 'puts("a  // b \\" /* c */");'
    assert strip_cpp_comments(plain) == plain


def test_a_checkout_of_cpp_changes_no_digest(tmp_path: Path) -> None:
    """Report: actions/runner#1246 (a checkout with CRLF has other hashes)."""
    text = KERNEL.read_text()
    changed = {
        "crlf.cpp": text.replace("\n", "\r\n").encode(),
        "mark.cpp": text.encode("utf-8-sig"),
        "comment.cpp": b"// A new comment.\n" + text.replace("\n", "  // why\n", 1).encode(),
    }
    for name, data in changed.items():
        (tmp_path / name).write_bytes(data)
        assert digest_source(tmp_path / name) == digest_source(KERNEL)
    (tmp_path / "code.cpp").write_text(text + "\nint added;\n")
    assert digest_source(tmp_path / "code.cpp") != digest_source(KERNEL)


def test_digests_of_different_kernels_differ() -> None:
    files = sorted(KERNEL.parent.glob("*.h"))
    assert all(digest_source(a) != digest_source(b) for a, b in pairwise([*files, KERNEL]))
