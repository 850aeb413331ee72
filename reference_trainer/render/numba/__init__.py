"""The engine of compiled loops; it needs numba."""
