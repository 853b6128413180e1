"""Measurements of `pd4dgs-bench`: codec, renderer, trainer, latency."""
