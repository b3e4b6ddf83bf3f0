"""The paper's tables as pages show them."""

from __future__ import annotations

import pytest

from docs.published_tables import published_table


@pytest.mark.parametrize(("number", "has_column"), [(1, True), (2, True), (4, False)])
def test_methods_without_exposure_are_also_compared_with_fitted_colours(number: int, has_column: bool) -> None:
    heads = [line for line in published_table(number).splitlines() if line.startswith("| method |")]
    # Two datasets with two tables; the column stands among what the paper does not have.
    assert ["colours fitted" in head for head in heads] == [False, has_column, False, has_column]
