"""Training: settings, loss, loop, checkpoints."""
