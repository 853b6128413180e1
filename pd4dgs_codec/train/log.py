"""The log of a run: a line of JSON per step."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Any

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.io import finite


class RecordLog:
    """Records appended to the file `path`; to none where it is None.

    failure: why a record could not be written, or None: the run saves its checkpoint before it raises that.
    """

    def __init__(self, path: Path | None):
        """Raises DataError for a file that cannot be opened."""
        self.path = path
        self.failure: DataError | None = None
        try:
            # by lines: a failed write shows at its step
            self._stream = open(path, "a", encoding="utf-8", buffering=1) if path else None
        except OSError as error:
            raise self._error(error) from None

    def write(self, record: dict[str, Any]) -> bool:
        """Whether the record is in the log, if there is one."""
        try:
            if self._stream:
                self._stream.write(json.dumps(finite(record), allow_nan=False) + "\n")
        except OSError as error:
            self.failure = self._error(error)
        return self.failure is None

    def close(self) -> None:
        """What a failed write left is lost; `failure` has told it."""
        if self._stream:
            with contextlib.suppress(OSError):
                self._stream.close()

    def _error(self, error: OSError) -> DataError:
        return DataError(f"{self.path}: the log cannot be written: {error.strerror or error}")
