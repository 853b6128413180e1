"""Libraries of scenes: one command over the lines of a manifest, on this machine, on Ray or on Slurm."""
