"""How C++ kernels are compiled, found and loaded; the kernels themselves live in the rooms that use them."""
