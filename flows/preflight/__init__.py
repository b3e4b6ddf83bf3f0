"""What a run needs, checked before any work: log, files, weights, packages, store, disk and memory."""
