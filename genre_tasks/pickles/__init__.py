"""Pickles of tables and arrays, read without running them."""
