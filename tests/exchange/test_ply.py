"""PLY files of 3D Gaussians."""

from __future__ import annotations

from tests.exchange.format_suite import FormatSuite


class TestPly(FormatSuite):
    name = "ply"
    keeps_bits = True
