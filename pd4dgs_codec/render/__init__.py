"""Cameras to pictures: one `rasterization` signature, numba kernels on the CPU, gsplat on CUDA.

Import `pd4dgs_codec.render.threads` first where the number of threads matters; `rasterization` needs torch and numba.
"""
