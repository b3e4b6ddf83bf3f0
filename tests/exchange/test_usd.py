"""OpenUSD packages and layers."""

from __future__ import annotations

from genre_tasks.exchange.cloud_errors import CloudErrors
from tests.exchange.format_suite import FormatSuite


class TestUsd(FormatSuite):
    name = "usdz"
    tolerances = CloudErrors(0, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6)
