"""Tools that compare results before and after a change of the code."""
