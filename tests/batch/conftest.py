"""Batches whose scenes are small texts, and whose command writes them in capitals."""

import json
from pathlib import Path
from typing import Any

import pytest
from standin import upper

from pd4dgs_codec.batch.job import OPS, Job, Line, Outcome, read_manifest
from pd4dgs_codec.batch.run import Settings, run


class Library:
    """Texts as sources, a manifest of them, and batches over it."""

    def __init__(self, folder: Path):
        self.folder, self.out, self.notes = folder, folder / "out", folder / "notes"
        (folder / "in").mkdir(exist_ok=True)
        self.notes.mkdir(exist_ok=True)
        self.lines: list[str] = []
        self.outcomes: dict[str, tuple[Outcome, int]] = {}

    def add(self, name: str, text: str, **fields: Any) -> None:
        """A source and its line."""
        (self.folder / "in" / name).write_text(text)
        self.lines.append(json.dumps({"source": str(self.folder / "in" / name)} | fields))

    def manifest(self) -> tuple[list[Line], list[tuple[int, str]]]:
        """The lines so far."""
        path = self.folder / "m.jsonl"
        path.write_text("\n".join(self.lines) + "\n")
        return read_manifest(str(path), OPS["encode"], lambda source, options: None)

    def run(
        self, on: str = "local", root: str | None = None, retries: int = 2, overwrite: bool = False, **settings: Any
    ) -> dict[str, Any]:
        """One batch over the lines so far; `outcomes` has the last outcome and the tries by output."""
        more = {"version": settings.pop("version")} if "version" in settings else {}
        jobs = (Job(line, "encode", root or str(self.out), 1, overwrite, **more) for line in self.manifest()[0])

        def report(job: Job, outcome: Outcome, tries: int) -> None:
            self.outcomes[job.line.output] = outcome, tries

        return run(jobs, upper, on, Settings(**{"workers": 0} | settings), retries, report)

    def made(self) -> list[str]:
        """The texts that the command has written, each as often as it was written."""
        return sorted(path.read_text() for path in self.notes.iterdir())


@pytest.fixture
def library(tmp_path, monkeypatch) -> Library:
    monkeypatch.setenv("COUNT", str(tmp_path / "notes"))
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", f"{here}:{Path(__file__).parents[2]}")  # of workers that are processes
    return Library(tmp_path)
