"""Which Prefect API a command's flows report to: the user's own server, or one that runs in a thread of the command."""
