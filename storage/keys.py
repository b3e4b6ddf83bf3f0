"""Digests of values, and the key of a stage: the digest over everything that its result depends on."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from typing import Any

from storage.files import digest_file

__all__ = ["canonical_json", "digest_bytes", "digest_file", "digest_value", "stage_key"]


def canonical_json(value: Any) -> str:
    """Writes a value as the one JSON text that equal values share: sorted keys, no spaces, shortest exact floats.

    Args:
        value: dictionaries, lists, strings, numbers, booleans and ``None``.

    Returns:
        The text.

    Raises:
        ValueError: a number is NaN or infinite, which JSON cannot hold.

    >>> canonical_json({"b": 1, "a": [0.1, None]})
    '{"a":[0.1,null],"b":1}'
    """
    # NaN is refused because it equals nothing, itself included: no key with it would ever be met again.
    return json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)


def digest_bytes(data: bytes) -> str:
    """Computes the sha256 of bytes.

    Args:
        data: any bytes.

    Returns:
        64 hex digits.
    """
    return hashlib.sha256(data).hexdigest()


def digest_value(value: Any) -> str:
    """Computes the sha256 of a value that JSON can hold.

    Args:
        value: as for :func:`canonical_json`; the order of a dictionary's keys does not matter.

    Returns:
        64 hex digits.

    Raises:
        ValueError: a number is NaN or infinite.

    >>> digest_value({"a": 1, "b": 2}) == digest_value({"b": 2, "a": 1})
    True
    """
    return digest_bytes(canonical_json(value).encode())


def stage_key(
    stage: str,
    code_digest: str,
    configuration: Mapping[str, Any],
    inputs: Mapping[str, str],
    weights_digest: str | None = None,
) -> str:
    """Computes the key of a stage's result: equal keys mean that the stored result can be used again.

    Args:
        stage: the stage's name, such as ``gnet`` or ``evaluate/gnet``.
        code_digest: digest of the stage's code (:func:`storage.code_digest.code_digest`).
        configuration: the stage's section of the configuration, as JSON values.
        inputs: name → digest of each input: a payload digest, or the digest of the log.
        weights_digest: digest of the network's weights; ``None`` for a stage without a network.

    Returns:
        64 hex digits.

    >>> len(stage_key("gnet", "c0de", {"iterations": 24}, {"initial": "5f41"}))
    64
    """
    # Names are part of the digest, so that a digest of weights can never pass for one of code.
    return digest_value(
        {
            "stage": stage,
            "code": code_digest,
            "configuration": dict(configuration),
            "inputs": dict(inputs),
            "weights": weights_digest,
        }
    )
