"""The renderer's C++ kernel: its sources, how it is compiled, and the types of its functions."""
