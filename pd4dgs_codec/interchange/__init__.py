"""Reads the files of other trainers and writes files for other viewers of Gaussians."""
