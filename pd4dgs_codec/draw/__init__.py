"""Cameras to pictures, without torch: Gaussians as numpy arrays in, a picture out (`rasteriser.draw`).

`autograd` is the same with gradients, for torch tensors, and alone imports torch. Import `pd4dgs_codec.threads`
first where the number of threads matters.
"""
