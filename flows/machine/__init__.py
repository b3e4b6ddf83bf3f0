"""What this machine is, how much memory a process may take, and how fast the machine is beside a reference."""
