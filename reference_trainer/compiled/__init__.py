"""Loops over arrays, compiled by numba, and the threads that run them."""
