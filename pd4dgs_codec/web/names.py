"""Names that carry the digest of what a file holds: it never changes, so caches may keep it."""

from __future__ import annotations

import hashlib
import re

#: What never changes may be kept for a year; of what may change caches ask each time whether it did.
IMMUTABLE, CHANGES = "public, max-age=31536000, immutable", "no-cache"
_ADDRESSED = re.compile(r"-[0-9a-f]{16}\.\w+$")


def addressed(name: str, content: bytes) -> str:
    """The name with the first 64 bits of the content's SHA-256: scene.pd4 -> scene-0123456789abcdef.pd4."""
    stem, dot, suffix = name.rpartition(".")
    return f"{stem}-{hashlib.sha256(content).hexdigest()[:16]}{dot}{suffix}"


def cache_control(name: str) -> str:
    """The header Cache-Control for a file of that name."""
    return IMMUTABLE if _ADDRESSED.search(name) else CHANGES
