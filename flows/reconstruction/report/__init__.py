"""The HTML report of a run: one file that opens from the disk, without a network."""
