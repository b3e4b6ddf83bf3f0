"""Variables of the environment that every HTTP client reads when it is made, whichever address it will ask."""

from __future__ import annotations

import os
import ssl

_FILES = ("SSL_CERT_FILE", "SSLKEYLOGFILE")
_NAMES = ("ssl_cert_dir", *(name.lower() for name in _FILES))


def is_network_variable(name: str) -> bool:
    """Finds out whether a variable changes how a client reaches this machine's own loopback.

    A company's proxy cannot reach it. A proxy or an exception from it that the client cannot read, and certificates
    that are not there, stop the client before it looks at the address.

    Args:
        name: of the variable, in any case.

    Returns:
        Whether it names a proxy, exceptions from one, certificates or a file for keys.

    >>> [name for name in ("HTTPS_PROXY", "no_proxy", "SSL_CERT_FILE", "HOME") if is_network_variable(name)]
    ['HTTPS_PROXY', 'no_proxy', 'SSL_CERT_FILE']
    """
    return name.lower().endswith("_proxy") or name.lower() in _NAMES


def find_unusable_files() -> dict[str, str]:
    """Finds variables that name a file which no client can use.

    Returns:
        The reason for each of them: no such file, no certificates in it, or a file that cannot be written.
    """
    return {name: reason for name in _FILES if (reason := _find_reason(name, os.environ.get(name, "")))}


def _find_reason(name: str, path: str) -> str | None:
    if not path:
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    try:
        if name == "SSL_CERT_FILE":
            context.load_verify_locations(cafile=path)
        else:
            context.keylog_filename = path
    except OSError as error:
        return error.strerror or str(error)
    return None
