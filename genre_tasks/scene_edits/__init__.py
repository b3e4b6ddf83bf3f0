"""Edits of a scene's traffic: actors removed, inserted, moved, and what that leaves behind."""
