"""Measurements that are processes of their own: another commit's package, or memory and caches of their own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from pages.page import Row
from pd4dgs_codec.errors import DataError


def printed(
    what: str, arguments: Sequence[str], *, environment: Mapping[str, str] | None = None, folder: Path | None = None
) -> Row:
    """The object that Python, run with these arguments in `folder`, prints in its last line.

    what: names the process in the DataError that says the last line of what it complained of, if it failed.
    """
    done = subprocess.run([sys.executable, *arguments], env=environment, capture_output=True, text=True, cwd=folder)
    if done.returncode:
        raise DataError(f"{what}: {(done.stderr.strip().splitlines() or ['it failed'])[-1]}")
    row: Row = json.loads(done.stdout.splitlines()[-1])
    return row


def command(checkout: Path, name: str, *arguments: str) -> Row:
    """What the command `name` of another checkout of this project prints with --json."""
    program = f"import sys; from pd4dgs_codec.cli.{name} import main; sys.exit(main())"
    environment = os.environ | {"PYTHONPATH": str(checkout)}
    line = ["-c", program, *arguments, "--json"]
    return printed(f"{name} of {checkout}", line, environment=environment, folder=checkout)
