"""Rasterising torch tensors, with gradients: `rasterization`, gsplat's signature, and the backends behind it.

Nothing in the rest of `render` imports this.
"""
