"""A store that fails now and then: `flaky:///path` is that path on the disk, behind calls of which some are refused.

A call fails before it does anything, or after it has done it, as a lost answer looks. `python_path(folder)` makes the
scheme known to fsspec in every process that is started with that PYTHONPATH.
"""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path
from typing import Any

from fsspec import AbstractFileSystem
from fsspec.implementations.local import LocalFileSystem

SHARE = float(os.environ.get("PD4DGS_FLAKY", "0.1"))  #: of the calls


class FlakyFileSystem(AbstractFileSystem):
    """What a batch calls of a store, with failures."""

    protocol = "flaky"
    cachable = False

    def __init__(self, **options: Any):
        super().__init__(**options)
        self.disk = LocalFileSystem()

    def _call(self, name: str, *args: Any, **named: Any) -> Any:
        fails, before = random.random() < SHARE, random.random() < 0.5
        if fails and before:
            raise OSError("the store is busy")
        result = getattr(self.disk, name)(*args, **named)
        if fails:
            raise OSError("the store gave no answer")
        return result

    def info(self, path: str, **named: Any) -> dict[str, Any]:
        """As on the disk, unless it fails."""
        return dict(self._call("info", path, **named))

    def cat_file(self, path: str, start: int | None = None, end: int | None = None, **named: Any) -> bytes:
        """As on the disk, unless it fails."""
        return bytes(self._call("cat_file", path, start, end, **named))

    def pipe_file(self, path: str, value: bytes, mode: str = "overwrite", **named: Any) -> None:
        """As on the disk, unless it fails: an object is there whole or not at all."""
        temporary = Path(f"{path}.{os.getpid()}.part")
        temporary.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(value)
        try:
            self._call("mv", str(temporary), path)
        finally:
            temporary.unlink(missing_ok=True)

    def get_file(self, rpath: str, lpath: str, **named: Any) -> None:
        """As on the disk, unless it fails."""
        self._call("get_file", rpath, lpath)

    def put_file(self, lpath: str, rpath: str, *args: Any, **named: Any) -> None:
        """As on the disk, unless it fails."""
        self.pipe_file(rpath, Path(lpath).read_bytes())


def python_path(folder: Path) -> str:
    """A folder for PYTHONPATH, made in `folder`, where this module is installed as an extension of fsspec."""
    about = folder / "flaky-1.dist-info"
    about.mkdir(parents=True, exist_ok=True)
    shutil.copy(__file__, folder / "flaky.py")
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: flaky\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[fsspec.specs]\nflaky = flaky:FlakyFileSystem\n")
    return str(folder)
