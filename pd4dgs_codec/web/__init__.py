"""Scenes over the web: a range server, a resuming client, the one-file page, packages with DASH and HLS manifests."""

#: The page of a folder.
PAGE = "index.html"


def is_url(name: str) -> bool:
    """Whether an input names a remote file. Imports no HTTP, so that local files do not wait for it."""
    return name.lower().startswith(("http://", "https://"))
