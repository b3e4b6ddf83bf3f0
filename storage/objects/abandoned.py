"""Objects that killed processes left behind: payloads without a manifest, leases that nobody renews, and probes."""

from __future__ import annotations

from pathlib import Path

from genre_tasks.errors import ArtifactCorruptError
from storage.manifest import MANIFEST, parse_manifest
from storage.objects.bucket import Bucket, ObjectInfo
from storage.objects.object_lease import LEASES_FOLDER
from storage.objects.payloads import find_payload_owner

PROBE_START = ".probe-"
"""How the names of objects begin that only try whether the store can be written."""


def find_abandoned(bucket: Bucket, probe: str, older_than_s: float) -> list[str]:
    """Finds objects that belong to no artifact and to no process at work.

    Args:
        bucket: of the store; all of it is listed.
        probe: name of an object that was written just now. Its time is compared with those of the others, as this
            machine's clock may differ from the server's.
        older_than_s: objects are found that were written so many seconds before the probe or earlier.

    Returns:
        The objects' names; the probe is not among them.

    Raises:
        InputError: the store must not be read.
        TransientIOError: the store does not answer, or the probe is gone.
    """
    payloads: dict[str, list[ObjectInfo]] = {}
    abandoned: list[ObjectInfo] = []
    now = None
    for info in bucket.list():
        if info.name == probe:
            now = info.modified
        elif info.name.startswith((f"{LEASES_FOLDER}/", PROBE_START)):
            abandoned.append(info)
        elif (folder := find_payload_owner(info.name)) is not None:
            payloads.setdefault(folder, []).append(info)
    if now is None:
        # Another process cleans at the same moment: it does the work.
        return []
    for folder, infos in payloads.items():
        # Read after the listing: what is committed meanwhile stays.
        found = bucket.read(f"{folder}/{MANIFEST}")
        digest = ""
        if found is not None:
            try:
                digest = parse_manifest(found.data, Path(folder, MANIFEST)).payload_digest[:12]
            except ArtifactCorruptError:
                # It may be a newer version's, whose files are not known here.
                continue
        abandoned += [info for info in infos if not digest or digest not in info.name[len(folder) :]]
    return [info.name for info in abandoned if (now - info.modified).total_seconds() >= older_than_s]
