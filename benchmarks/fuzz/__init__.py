"""Damaged and harmful files of every format, fed to the readers of the project."""
