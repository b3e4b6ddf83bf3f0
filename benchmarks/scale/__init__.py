"""Measurements of many logs on many workers."""
