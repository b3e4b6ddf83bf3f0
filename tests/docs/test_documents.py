"""Documents are true: generated parts are those of code and measurements, links lead somewhere, the site builds."""

from __future__ import annotations

import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
README_LINES = 150
DOCS_BYTES = 4_000_000
SENTENCE_WORDS = 30
# A measured number has a decimal point, a unit or a percent sign. Versions, sizes and settings are no measurements.
MEASURED = re.compile(r"\d+\.\d+|\d+ ?%|\b\d+ (?:dB|ms|times)\b")
NO_MEASUREMENT = re.compile(
    r"[Vv]ersion \d+\.\d+|Python \d+\.\d+|\d+\.\d+\.\d+|Apache-2\.0|(?<![\d.])0\.[12](?!\d)|prefect 3\.8"
)


@pytest.fixture(scope="module")
def generator() -> dict[str, Any]:
    return runpy.run_path(str(ROOT / "docs/generate.py"))


def prose(text: str) -> str:
    """A page without generated blocks, code, tables and comments: what a person wrote as sentences."""
    text = re.sub(r"<!-- generated: .*?<!-- end -->", "", text, flags=re.DOTALL)
    text = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    text = re.sub(r"`[^`\n]*`", "x", text)
    text = re.sub(r"\]\([^)]*\)", "]", text)
    return "\n".join(line for line in text.splitlines() if not line.startswith(("|", "![", ":::", "--8<--")))


def sentences(text: str) -> list[str]:
    """The sentences of a page's prose; a list item or a heading ends a sentence too."""
    blocks = re.split(r"\n\s*\n|\n(?=[*#]|\d+\. )", prose(text))
    return [s.strip() for block in blocks for s in re.split(r"(?<=[.!?:])\s", " ".join(block.split())) if s.strip()]


def test_generated_parts_are_those_of_code_and_measurements(generator: dict[str, Any]) -> None:
    stale = [p.relative_to(ROOT).as_posix() for p, text in generator["documents"]().items() if p.read_text() != text]
    assert not stale, f"run `make docs`: {stale}"


def test_a_block_without_an_end_is_refused(generator: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="no end"):
        generator["filled"]("<!-- generated: presets -->\nwords\n<!-- generated: glance -->\n<!-- end -->\n")


@pytest.mark.parametrize("page", [PAGES[0], *sorted((ROOT / "docs/results").glob("*.md"))], ids=lambda p: p.name)
def test_no_measured_number_is_typed_by_hand(page: Path) -> None:
    text = NO_MEASUREMENT.sub("", prose(page.read_text()))
    assert not MEASURED.findall(text)


def test_the_readme_is_short_and_has_its_limits_and_picture() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= README_LINES
    assert "## Limits" in text
    assert re.search(r"!\[[^\]]+\]\(docs/images/", "\n".join(text.splitlines()[:12])), "a picture in the first screen"


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_sentences_are_short(page: Path) -> None:
    if "reference/stability" in str(page):
        return
    long = [s for s in sentences(page.read_text()) if len(s.split()) > SENTENCE_WORDS]
    assert not long


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_lead_to_files_and_headings_that_exist(page: Path) -> None:
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if target.startswith(("http", "#")):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve()
        assert found.exists(), f"{page.name} links to {target}"
        if anchor:
            titles = re.findall(r"^#+ (.*)$", found.read_text(), flags=re.MULTILINE)
            slugs = {re.sub(r"[^\w -]", "", t).strip().lower().replace(" ", "-") for t in titles}
            assert anchor in slugs, f"{page.name} links to {target}"


def test_pictures_have_a_description() -> None:
    for page in PAGES:
        assert "![](" not in page.read_text(), page


def test_the_documents_are_small() -> None:
    total = sum(p.stat().st_size for p in (ROOT / "docs").rglob("*") if p.is_file())
    assert total < DOCS_BYTES


def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "WARNING" not in done.stderr
    assert (tmp_path / "index.html").is_file()


def test_model_cards_have_at_most_forty_lines() -> None:
    for card in (ROOT / "genre_tasks/weights").glob("*.md"):
        assert len(card.read_text().splitlines()) <= 40, card.name


def test_the_release_has_one_version() -> None:
    import tomllib

    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert f"version: {version}" in (ROOT / "CITATION.cff").read_text()
    assert f"## {version} " in (ROOT / "CHANGELOG.md").read_text()
