"""The tables of the PD-4DGS paper, made from our own trainings: comparison, sampling, components, levels, latency,
and beside them the curve of quality over bytes as the rate weight moves and the course of rho over training."""
