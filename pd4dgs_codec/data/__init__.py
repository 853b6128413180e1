"""Dataset readers and the synthetic scenes: `dataset.load`. Importing the package loads none of them."""
