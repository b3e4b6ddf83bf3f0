"""The Kubernetes manifests have the fields and the types of the Kubernetes client's models."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml

from tests.faults import small_run


def _check(value: Any, kind: str, where: str) -> None:
    import kubernetes.client.models as models

    listed = re.fullmatch(r"list\[(.*)\]", kind)
    mapped = re.fullmatch(r"dict\(str, (.*)\)|dict\[str, (.*)\]", kind)
    if listed:
        assert isinstance(value, list), where
        for entry in value:
            _check(entry, listed[1], where)
    elif mapped:
        assert isinstance(value, dict), where
        for name, entry in value.items():
            _check(entry, mapped[1] or mapped[2], f"{where}.{name}")
    elif kind in {"str", "int", "bool"}:
        assert type(value).__name__ == kind, f"{where}: {value!r} is no {kind}"
    elif hasattr(models, kind):
        model = getattr(models, kind)
        fields = {written: model.openapi_types[name] for name, written in model.attribute_map.items()}
        assert set(value) <= set(fields), f"{where}: {set(value) - set(fields)}"
        for name, entry in value.items():
            _check(entry, fields[name], f"{where}.{name}")


def test_manifests_follow_the_api() -> None:
    pytest.importorskip("kubernetes")
    text = (small_run.ROOT / "docs/examples/kubernetes/workers.yaml").read_text()
    for manifest in yaml.safe_load_all(text):
        _check(manifest, "V1Deployment", manifest["metadata"]["name"])
        labels = manifest["spec"]["template"]["metadata"]["labels"]
        assert manifest["spec"]["selector"]["matchLabels"] == labels
    with pytest.raises(AssertionError, match="replica"):
        _check({"spec": {"replica": 1}}, "V1Deployment", "wrong")
