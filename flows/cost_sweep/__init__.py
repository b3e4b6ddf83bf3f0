"""What accuracy costs in time: the knobs of a run, turned one at a time and a few together, and what each buys."""
