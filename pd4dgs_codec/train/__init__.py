"""Training: losses, rollout over levels, growing and pruning, the step and the run."""
