"""From a trained scene to a file worth sending: target sizes, layers that pay, the trainer's own rate."""
