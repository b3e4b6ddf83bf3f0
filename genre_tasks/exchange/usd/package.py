"""USDZ packages: archives without compression, whose layers are read in a folder that holds nothing else."""

from __future__ import annotations

import errno
import struct
import zipfile
from pathlib import Path, PurePosixPath

from genre_tasks.errors import InputError

LAYER_SUFFIXES = (".usdc", ".usda", ".usd")
"""Ends of the names of layers; other members of a package, such as pictures, are not read."""

_MAX_MEMBERS = 10_000
_MAX_LAYERS = 64
# The specification asks that a member's bytes start at a multiple of this.
_ALIGNMENT_BYTES = 64
_LOCAL_HEADER_BYTES = 30
_EXTRA_HEADER_BYTES = 4
# The number that OpenUSD itself gives to its padding.
_PADDING_ID = 0x1986
# The earliest date that an archive can hold: the same scene gives the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)
_BLOCK_BYTES = 1 << 20


def write_package(path: Path, layer: Path) -> None:
    """Writes a package that holds one layer.

    Args:
        path: the package; an existing one is replaced.
        layer: the layer's file, below 1.9 GiB: OpenUSD reads no Zip64.

    Raises:
        OSError: a file cannot be read or written.
    """
    entry = zipfile.ZipInfo(layer.name, _DATE)
    entry.external_attr = 0o644 << 16
    entry.file_size = layer.stat().st_size
    before = _LOCAL_HEADER_BYTES + len(layer.name) + _EXTRA_HEADER_BYTES
    padding = -before % _ALIGNMENT_BYTES
    entry.extra = struct.pack("<HH", _PADDING_ID, padding) + bytes(padding)
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive,
        archive.open(entry, "w") as member,
        layer.open("rb") as file,
    ):
        while block := file.read(_BLOCK_BYTES):
            member.write(block)


def extract_layers(path: Path, folder: Path) -> Path:
    """Copies a package's layers into a folder.

    Args:
        path: the package.
        folder: an empty folder; nothing is written outside of it.

    Returns:
        The package's first layer, which is the one that is shown.

    Raises:
        InputError: the file is no package, or a member is compressed, encrypted, cut off, or would leave the folder.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            members = _check_members(archive, path)
            for member in members:
                target = folder / member.filename
                target.parent.mkdir(parents=True, exist_ok=True)
                # The sum that the archive gives is checked on the way.
                with archive.open(member) as source, target.open("xb") as file:
                    while block := source.read(_BLOCK_BYTES):
                        file.write(block)
    except (zipfile.BadZipFile, EOFError, NotImplementedError, struct.error, ValueError, OverflowError) as error:
        raise _damage("the package cannot be read", path) from error
    except OSError as error:
        # A member that begins before the file does is sought there.
        if error.errno != errno.EINVAL:
            raise
        raise _damage("the package cannot be read", path) from error
    return folder / members[0].filename


def _check_members(archive: zipfile.ZipFile, path: Path) -> list[zipfile.ZipInfo]:
    members = [member for member in archive.infolist() if not member.is_dir()]
    if len(members) > _MAX_MEMBERS:
        raise _damage(f"the package has {len(members)} members", path)
    for member in members:
        if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
            problem = f"'{member.filename}' is compressed or encrypted, which a USDZ package does not allow"
            raise _damage(problem, path)
        name = PurePosixPath(member.filename)
        is_inside = not name.is_absolute() and ".." not in name.parts
        if not is_inside or "\\" in member.filename or ":" in member.filename or not member.filename.isprintable():
            raise _damage(f"the member {member.filename!r} would lie outside of the package", path)
    # Members that share their bytes are how a small archive becomes a large folder.
    if sum(member.file_size for member in members) > path.stat().st_size:
        raise _damage("the package's members claim more bytes than it has", path)
    layers = [member for member in members if member.filename.lower().endswith(LAYER_SUFFIXES)]
    if not layers or members[0] is not layers[0]:
        raise _damage("the package's first member is no layer", path)
    if len(layers) > _MAX_LAYERS:
        raise _damage(f"the package has {len(layers)} layers", path)
    if len({layer.filename.lower() for layer in layers}) != len(layers):
        raise _damage("two layers of the package share one name", path)
    return layers


def _damage(problem: str, path: Path) -> InputError:
    return InputError(problem, remedy="Export the scene again, as a USDZ package.", file=path)
