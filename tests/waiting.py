"""Wait for what another process does."""

import time

PATIENCE = 180  # seconds; a failure takes that long, and a busy machine needs a minute to start a few processes


def until(condition, seconds=PATIENCE):
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)
