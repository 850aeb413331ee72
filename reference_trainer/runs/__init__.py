"""Runs, from photographs to scores in a folder; grids of runs; and measuring anyone's PLY like a run."""
