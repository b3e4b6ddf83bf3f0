"""Scenes out of a store into files of other people's tools, and from such files into a store."""
