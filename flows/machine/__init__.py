"""The machine: what it is, how much memory a process may use, how fast it is, and what a piece of work takes."""
