"""Progress on stderr: bars on a terminal, otherwise a plain line from time to time."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.common import say

if TYPE_CHECKING:
    from pd4dgs_codec.train.loop import Trainer

#: Least time between two lines if stderr is not a terminal.
LINE_SECONDS = 10.0


@contextlib.contextmanager
def progress_bar(total: int | None, unit: str, label: str) -> Iterator[Callable[[], None]]:
    """Yields a function to call after each item. Shows a bar on a terminal, otherwise a line every LINE_SECONDS."""
    if sys.stderr.isatty():
        from tqdm import tqdm

        with tqdm(total=total, unit=unit, desc=label, leave=False, file=sys.stderr) as bar:

            def advance() -> None:
                bar.update(1)

            yield advance
        return
    done, told = 0, time.monotonic()

    def count_one() -> None:
        nonlocal done, told
        done += 1
        if time.monotonic() - told > LINE_SECONDS:
            told = time.monotonic()
            say(f"{label}: {done}{f' of {total}' if total else ''} {unit}")

    yield count_one


class TrainingProgress:
    """Shows a bar on a terminal, otherwise a line after each evaluation."""

    def __init__(self) -> None:
        self.stream = sys.stderr
        self.bar: Any = None

    def update(self, trainer: Trainer, record: dict[str, Any]) -> None:
        psnr = "/".join(f"{value:.2f}" for value in trainer.curve[-1]["psnr"]) if trainer.curve else ""
        if self.stream.isatty():
            self._bar(trainer).set_postfix_str(f"{record['anchors']} anchors {psnr} dB" if psnr else "", refresh=False)
            self.bar.update((int(trainer.seconds) if trainer.timed else trainer.iteration) - self.bar.n)
        elif "held_out_psnr" in record:
            steps = f"step {trainer.iteration}" if trainer.timed else f"step {trainer.iteration}/{trainer.total}"
            limit = f" of {trainer.config.max_seconds:g}" if trainer.timed else ""
            say(f"{steps}, {trainer.seconds:.0f}{limit} s: {psnr} dB, {record['anchors']} anchors")

    def on_trial(self, done: int, steps: int) -> None:
        if self.bar is not None:
            self.bar.set_postfix_str(f"trial of motion or levels: step {done + 1}/{steps}")

    def close(self) -> None:
        if self.bar is not None:
            self.bar.close()

    def _bar(self, trainer: Trainer) -> Any:
        if self.bar is None:
            from tqdm import tqdm

            total, unit = (trainer.config.max_seconds, "s") if trainer.timed else (trainer.total, "step")
            initial = int(trainer.seconds) if trainer.timed else trainer.iteration - 1
            self.bar = tqdm(total=total, initial=initial, unit=unit, file=self.stream, leave=False)
        return self.bar
