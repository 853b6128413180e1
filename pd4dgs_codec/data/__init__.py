"""Dataset readers and the synthetic scenes."""

from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.data.view import Dataset, View

__all__ = ["Dataset", "View", "load"]
