"""Loops over arrays that numba compiles, and the threads that run them."""
