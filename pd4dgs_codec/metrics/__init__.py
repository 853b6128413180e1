"""Picture quality."""

from pd4dgs_codec.metrics.image import mean_image_baseline, mpsnr, mssim, to_uint8
from pd4dgs_codec.metrics.perceptual import Distance, Perceptual, load_perceptual

__all__ = ["Distance", "Perceptual", "load_perceptual", "mean_image_baseline", "mpsnr", "mssim", "to_uint8"]
