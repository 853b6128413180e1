"""Dataset readers, the synthetic scenes, and the exporter to the iPhone layout."""

from .dataset import Dataset, View, load

__all__ = ["Dataset", "View", "load"]
