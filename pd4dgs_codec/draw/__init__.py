"""Draws scenes on the CPU by numba kernels, without torch: numpy arrays in, Gaussians and pictures out.

`player.Player` draws a decoded scene, `rasteriser.draw` any Gaussians. `pd4dgs_codec.threads.configure` sets the number
of threads.
"""
