"""Keys: digests over values, files and a stage's recipe."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from storage.files import digest_file

__all__ = ["canonical_json", "digest_bytes", "digest_file", "digest_value", "stage_key"]


def canonical_json(value: Any) -> str:
    """One text for one value: sorted keys, no spaces, shortest exact floats. NaN and infinity raise ``ValueError``."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest_bytes(data: bytes) -> str:
    """sha256 (hex)."""
    return hashlib.sha256(data).hexdigest()


def digest_value(value: Any) -> str:
    """sha256 (hex) of a JSON-able value; the order of a mapping's keys does not matter."""
    return digest_bytes(canonical_json(value).encode())


def stage_key(
    stage: str,
    code_digest: str,
    configuration: Mapping[str, Any],
    inputs: Mapping[str, str],
    weights_digest: str | None = None,
    plan_digest: str | None = None,
    extra: Sequence[str] = (),
) -> str:
    """The recipe's digest: 64 hex digits.

    Args:
        stage: ``gnet``, ``evaluate/gnet``.
        code_digest: of the stage's import closure (:func:`storage.code_digest.code_digest`).
        configuration: the stage's own subtree, JSON-able.
        inputs: name → digest of the input (a payload digest, or the log's digest).
        weights_digest, plan_digest: of the network's weights and of the effect plan, where there are any.
        extra: anything else that the result depends on, in order.
    """
    return digest_value(
        {
            "stage": stage,
            "code": code_digest,
            "configuration": dict(configuration),
            "inputs": dict(inputs),
            "weights": weights_digest,
            "plan": plan_digest,
            "extra": list(extra),
        }
    )
