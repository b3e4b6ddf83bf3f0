"""The benchmark of HTTP and of the driving environment: it measures the tiny run, and its claims can fail."""

from __future__ import annotations

from benchmarks.exchange.http_service import measure_driving, measure_http_service
from benchmarks.exchange.service_report import http_service_claims, http_service_table


def test_http_and_driving_are_measured(served: tuple[str, str]) -> None:
    row = measure_http_service(*served, images=6)
    assert row["max_difference"] <= 1 and row["http_ms"]["n"] == 6 and row["size_px"] == [64, 36]
    driving = measure_driving(*served, steps=3)
    assert driving["cameras"] == 2 and 1 <= driving["steps_per_s"]["n"] <= 3
    names = [made.id for made in http_service_claims([row], [driving])]
    assert names == ["exchange.http_overhead", "exchange.http_difference", "exchange.driving_steps"]
    assert "64×36" in "\n".join(http_service_table([row], [driving]))
    slow = {"median": 9999.0, "low": 1.0, "high": 1.0, "n": 6}
    still = driving | {"steps_per_s": {"median": 0.1, "low": 0.1, "high": 0.1, "n": 3}}
    bad = http_service_claims([row | {"http_ms": slow, "max_difference": 9}], [still])
    assert not any(made.holds for made in bad)
    assert not any(made.holds for made in http_service_claims([], []))
