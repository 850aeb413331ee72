"""Experiments on top of everything else: single runs, comparisons, and their reports."""
