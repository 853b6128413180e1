"""What `pd4dgs-bench` measures: codec, renderer, trainer, latency, stability."""
