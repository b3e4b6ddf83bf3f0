"""The guide and the rules for Prometheus name what the code has."""

from __future__ import annotations

import re
from pathlib import Path

import yaml

from flows.observability.log_records import LOG_FORMAT, prefect_log_variables
from flows.observability.metric_definitions import METRICS, OUTCOMES

ROOT = Path(__file__).resolve().parents[2]
GUIDE = (ROOT / "docs/guides/observability.md").read_text()


def list_names() -> set[str]:
    """Every name of a series that the exporter may answer."""
    names = set()
    for metric in METRICS:
        ends = ("_bucket", "_count", "_sum") if metric.kind == "histogram" else ("",)
        names |= {metric.name + end for end in ends}
    return names


def test_the_guide_has_the_table_of_metrics() -> None:
    rows = [f"| `{m.name}` | {m.kind} | {', '.join(f'`{label}`' for label in m.labels)} | {m.help} |" for m in METRICS]
    assert re.findall(r"^\| `genre_.*$", GUIDE, re.MULTILINE) == rows
    assert all(f"`{outcome}`" in GUIDE for outcome in OUTCOMES)


def test_the_guide_has_the_variables_of_a_worker() -> None:
    exported = dict(re.findall(r"^export (\w+)=(\S+)$", GUIDE, re.MULTILINE))
    assert exported == prefect_log_variables()
    assert LOG_FORMAT in exported


def test_the_rules_name_metrics_that_exist() -> None:
    rules = yaml.safe_load((ROOT / "docs/examples/prometheus/alerts.yaml").read_text())["groups"][0]["rules"]
    assert len({rule["alert"] for rule in rules}) == len(rules)
    labels = {label for metric in METRICS for label in metric.labels} | {"instance"}
    for rule in rules:
        named = set(re.findall(r"\bgenre_\w+", rule["expr"]))
        assert named and named <= list_names()
        assert set(re.findall(r"\$labels\.(\w+)", rule["annotations"]["summary"])) <= labels
        assert set(re.findall(r'outcome="(\w+)"', rule["expr"])) <= set(OUTCOMES)
    assert set(re.findall(r"\bgenre_\w+", GUIDE)) <= list_names() | {"genre_stage_seconds"}
