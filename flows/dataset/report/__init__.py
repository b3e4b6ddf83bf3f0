"""The report of a dataset: one HTML file."""
