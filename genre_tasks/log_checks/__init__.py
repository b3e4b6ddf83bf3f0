"""Checks of a driving log before hours are spent on it: what it has, what it lacks, and what is implausible."""
