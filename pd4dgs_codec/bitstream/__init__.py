"""Bytes <-> fields: the container's framing, canonical msgpack, and the format's limits."""
