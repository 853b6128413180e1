"""Gaussians in and out: the files that other viewers read and that other trainers write."""
