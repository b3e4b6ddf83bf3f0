"""Objects of a bucket that killed processes left behind: payloads without a manifest, leases and probes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

from genre_tasks.errors import ArtifactCorruptError
from storage.manifest import MANIFEST, parse_manifest
from storage.objects.bucket import Bucket, ObjectInfo
from storage.objects.object_lease import LEASES_FOLDER
from storage.objects.payloads import ETAGS_START, PAYLOAD_START, is_payload

PROBE_START = ".probe-"
"""How the names of objects begin that are written to find out whether that is permitted."""


def remove_abandoned_objects(bucket: Bucket, older_than_s: float) -> int:
    """Removes what no artifact and no living process needs. The whole bucket is listed.

    Args:
        bucket: of the store.
        older_than_s: objects go when they were written so many seconds ago or earlier, by the server's clock.

    Returns:
        How many objects were removed.

    Raises:
        InputError: the store cannot be read or written.
        TransientIOError: the store does not answer.
    """
    payloads: dict[str, list[ObjectInfo]] = {}
    abandoned: list[ObjectInfo] = []
    for info in bucket.list():
        if info.name.startswith((f"{LEASES_FOLDER}/", PROBE_START)):
            abandoned.append(info)
        elif is_payload(info.name):
            folder = info.name.partition(f"/{PAYLOAD_START}")[0].partition(f"/{ETAGS_START}")[0]
            payloads.setdefault(folder, []).append(info)
    for folder, infos in payloads.items():
        found = bucket.read(f"{folder}/{MANIFEST}")
        digest = ""
        if found is not None:
            try:
                digest = parse_manifest(found.data, Path(folder, MANIFEST)).payload_digest[:12]
            except ArtifactCorruptError:
                # It may be a newer version's, whose files are not known here.
                continue
        abandoned += [info for info in infos if not digest or digest not in info.name[len(folder) :]]
    now = datetime.now(UTC)
    old = [info.name for info in abandoned if (now - info.modified).total_seconds() >= older_than_s]
    bucket.delete(old)
    return len(old)
