"""Scenes to pictures, without torch: numpy arrays in, Gaussians and pictures out, by numba kernels on the CPU.

`player.Player` draws a decoded scene, `rasteriser.draw` any Gaussians. Import `pd4dgs_codec.threads` first where the
number of threads matters.
"""
