"""Conformance vectors: what is in each file, and how its bytes are written. `tools/make_vectors.py` writes them out."""
