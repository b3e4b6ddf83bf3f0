"""Credentials in URIs, masked before anything is written to a log."""

from __future__ import annotations

import re

MASK = "***"
"""Stands where a secret was."""

# The greedy part reaches the last "@" before the path: a password may hold one.
_USER = re.compile(r"(?P<scheme>\b[a-zA-Z][a-zA-Z0-9+.-]*://)[^\s/?#'\"<>]+@")
# Parameters of signed URLs of AWS, Google and Azure, and variables such as AWS_SECRET_ACCESS_KEY=…
_PARAMETER = re.compile(
    r"(?P<name>\b[\w-]{0,40}?(?:signature|credential|security-token|access_?key_?id|googleaccessid|access_key"
    r"|secret_key|auth_string|api_?key|password|(?<![a-z0-9])(?:sig|token|session_token|access_token))=)"
    r"[^&;\s'\"<>]+",
    re.IGNORECASE,
)
_HEADER = re.compile(r"(?P<name>\bauthorization['\"]?\s*[:=]\s*['\"]?(?:basic|bearer)\s+)[^\s'\"]+", re.IGNORECASE)


def redact(text: str) -> str:
    """Masks user, password and signed parameters of all URIs of a text, and the value of authorization headers.

    Args:
        text: any text.

    Returns:
        The text with :data:`MASK` for each secret.

    >>> redact("cannot read s3://me:pass@host/bucket/key?X-Amz-Signature=0a1b&part=2")
    'cannot read s3://***@host/bucket/key?X-Amz-Signature=***&part=2'
    """
    # Most texts have none of these; the patterns would cost more than the rest of a record.
    if "://" in text:
        text = _USER.sub(rf"\g<scheme>{MASK}@", text)
    if "=" in text:
        text = _PARAMETER.sub(rf"\g<name>{MASK}", text)
    if "uthorization" in text.lower():
        text = _HEADER.sub(rf"\g<name>{MASK}", text)
    return text
