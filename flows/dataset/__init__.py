"""A dataset of logs: child runs through a work pool, their supervision, the table of all logs, and the record."""
