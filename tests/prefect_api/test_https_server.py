"""A Prefect server behind HTTPS is trusted by the settings that Prefect's own client honours."""

from __future__ import annotations

import ipaddress
import ssl
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from prefect.settings import (
    PREFECT_API_SSL_CERT_FILE,
    PREFECT_API_TLS_INSECURE_SKIP_VERIFY,
    PREFECT_API_URL,
    temporary_settings,
)

from flows.prefect_api.connection import check_server
from genre_tasks.errors import ConfigError

# A server that wants a password counts as one that answers, and its client's error as one of the password.
ACCEPTED = "does not serve this client"
REFUSED = "no Prefect server answers at .*CERTIFICATE_VERIFY_FAILED"


def write_certificate(folder: Path) -> tuple[Path, Path]:
    """A certificate for 127.0.0.1 that nobody but itself vouches for, and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "127.0.0.1")])
    now = datetime.now(UTC)
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    # What a strict client wants of a certificate that vouches for itself.
    usage = x509.KeyUsage(
        digital_signature=True,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=True,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))
        .not_valid_after(now + timedelta(days=1))
        .add_extension(address, critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    (folder / "server.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    key_bytes = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    (folder / "key.pem").write_bytes(key_bytes)
    return folder / "server.pem", folder / "key.pem"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return write_certificate(tmp_path_factory.mktemp("certificate"))


@pytest.fixture
def url(certificate: tuple[Path, Path]) -> Iterator[str]:
    """Address of an HTTPS server that answers everything with the wish for a password."""

    class Server(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(401)
            self.end_headers()

        def log_message(self, *args: object) -> None:
            pass

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)
    with HTTPServer(("127.0.0.1", 0), Server) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"https://127.0.0.1:{server.server_port}/api"
        finally:
            server.shutdown()


def test_a_certificate_that_nobody_vouches_for_is_refused(url: str) -> None:
    with temporary_settings({PREFECT_API_URL: url}), pytest.raises(ConfigError, match=REFUSED):
        check_server(url)


def test_the_certificate_of_prefects_settings_is_trusted(url: str, certificate: tuple[Path, Path]) -> None:
    settings = {PREFECT_API_URL: url, PREFECT_API_SSL_CERT_FILE: str(certificate[0])}
    with temporary_settings(settings), pytest.raises(ConfigError, match=ACCEPTED):
        check_server(url)


def test_certificates_are_not_checked_where_prefects_settings_say_so(url: str) -> None:
    settings = {PREFECT_API_URL: url, PREFECT_API_TLS_INSECURE_SKIP_VERIFY: True}
    with temporary_settings(settings), pytest.raises(ConfigError, match=ACCEPTED):
        check_server(url)


@pytest.mark.parametrize("content", [None, "no certificate"])
def test_a_file_without_certificates_is_named(
    url: str, content: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "ca.pem"
    if content is not None:
        file.write_text(content)
    monkeypatch.setenv("PREFECT_API_SSL_CERT_FILE", str(file))
    settings = {PREFECT_API_URL: url, PREFECT_API_SSL_CERT_FILE: str(file)}
    problem = r"PREFECT_API_SSL_CERT_FILE=.*ca\.pem cannot be used.*unset PREFECT_API_SSL_CERT_FILE"
    with temporary_settings(settings), pytest.raises(ConfigError, match=problem):
        check_server(url)
