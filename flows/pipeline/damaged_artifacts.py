"""Removes damaged artifacts, so that the next run computes them again."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress

from genre_tasks.errors import ArtifactCorruptError, GenreError
from genre_tasks.progress import Progress, silent
from storage.address import Address
from storage.store import Store


def discard_if_damaged(store: Store, address: Address, progress: Progress = silent) -> None:
    """Removes an artifact if any of its bytes is damaged; a sound one stays, and nothing happens where there is none.

    Args:
        store: that has it.
        address: of the artifact.
        progress: called while another process computes the artifact.

    Raises:
        NewerSchemaError: a newer version of the project wrote it.
        InputError: the store cannot be read or written.
        TransientIOError: the store does not answer.
    """
    # A run may have computed it again since the damage was found.
    with store.lease(address, progress):
        artifact = None
        try:
            artifact = store.find(address)
            if artifact is not None:
                # A bucket's listing shows nothing of a damage on the server's disk.
                store.verify(artifact, reads_all=True)
        except ArtifactCorruptError:
            # Just the one that was found: commits need no lease.
            store.discard(artifact or address)


def discard_damaged_inputs(store: Store, addresses: Iterable[Address], progress: Progress = silent) -> None:
    """Removes the damaged ones among a stage's inputs, after the stage has met damage.

    Look-ups trust a bucket's listing, so that an input with damaged bytes would end every later run, too.

    Args:
        store: that has the inputs.
        addresses: of the inputs.
        progress: called while another process computes one of them.
    """
    for address in addresses:
        # The stage's own error says what is wrong. What cannot be removed now stays for `genre verify --repair`.
        with suppress(GenreError):
            discard_if_damaged(store, address, progress)
