"""A Markdown page that holds the sections of several tables, each replaced by itself."""

from __future__ import annotations

import re
from pathlib import Path

from flows.experiments.result_files import write_text
from genre_tasks.errors import InputError

PREFACE = (
    "# The paper's tables, measured here\n\n"
    "Each section is written by the command that it states, `genre table N … --into FILE`.\n"
)


def replace_section(file: Path, number: int, dataset: str, text: str) -> None:
    """Writes a section of a page, and leaves the others as they are.

    Sections are in the order of the tables, those of one table in the order of the datasets' names.

    Args:
        file: the page; it and its folder are made where they are missing.
        number: of the table.
        dataset: of the logs.
        text: Markdown of the section.

    Raises:
        InputError: the page cannot be read, or the comments around its sections do not pair up.
    """
    begin = f"<!-- genre table {number} on {dataset} -->"
    end = f"<!-- end of table {number} on {dataset} -->"
    try:
        # An unreadable page is an error: starting afresh would overwrite other tables.
        old = file.read_text(encoding="utf-8") if file.exists() else PREFACE
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"the page cannot be read: {error}", remedy="Check --into.", file=file) from error
    section = f"{begin}\n\n{text.strip()}\n\n{end}"
    if begin in old or end in old:
        # Guessing where a section ends could delete what the user wrote around it.
        if not (old.count(begin) == old.count(end) == 1 and old.index(begin) < old.index(end)):
            raise InputError(
                f"the page does not hold one section between '{begin}' and '{end}'",
                remedy="Mend its marks, or remove the page.",
                file=file,
            )
        new = old[: old.index(begin)] + section + old[old.index(end) + len(end) :]
    else:
        position = _find_position(old, number, dataset)
        new = old[:position].rstrip("\n") + f"\n\n{section}\n\n" + old[position:]
    file.parent.mkdir(parents=True, exist_ok=True)
    # The page appears whole or not at all, because it also holds sections that took hours.
    write_text(file, new.rstrip("\n") + "\n")


def _find_position(page: str, number: int, dataset: str) -> int:
    """Finds where the first section starts that comes after this one; the page's end without such a section."""
    for match in re.finditer(r"<!-- genre table (\d) on (\S+) -->", page):
        # Sorted by table and data set, so that two pages made in different orders are equal.
        if (int(match[1]), match[2]) > (number, dataset):
            return match.start()
    return len(page)
