"""Picture quality."""

from .image import mean_image_baseline, mpsnr, mssim, to_uint8

__all__ = ["mean_image_baseline", "mpsnr", "mssim", "to_uint8"]
