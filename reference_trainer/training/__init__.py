"""Training: settings, plan, recipes, loop, checkpoints."""
