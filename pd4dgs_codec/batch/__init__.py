"""Runs one command on all scenes of a manifest: on this machine, on Ray or on Slurm."""
