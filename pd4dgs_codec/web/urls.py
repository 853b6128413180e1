"""Which inputs are remote files. It imports no HTTP, so that a local file waits for none."""

from __future__ import annotations


def is_url(name: str) -> bool:
    """Whether an input names a remote file."""
    return name.lower().startswith(("http://", "https://"))
