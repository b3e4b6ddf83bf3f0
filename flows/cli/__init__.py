"""The ``genre`` command: one module for each subcommand, and what they print."""
