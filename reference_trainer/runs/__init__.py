"""Runs: from photographs to scores in a folder, many of them side by side, and anyone's model in place of a run."""
