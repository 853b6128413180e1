"""Picture quality: `image` by the pixel, `perceptual` by networks."""
