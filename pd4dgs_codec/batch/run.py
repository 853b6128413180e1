"""A batch: jobs from a manifest through an engine, tried again within a bound, and summed up."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from pd4dgs_codec.batch.engines import Engine, EngineSettings
from pd4dgs_codec.batch.job import ALREADY, DONE, FAILED, Job, Outcome, run_job
from pd4dgs_codec.batch.ops import Command


class JobFeed:
    """Jobs in the order of their lines; those that failed come again once all others have begun."""

    def __init__(self, jobs: Iterator[Job]):
        self._jobs, self._again = jobs, deque[Job]()

    def take(self) -> Job | None:
        """The next job, None if there is none now."""
        job = next(self._jobs, None)
        return job if job is not None else self._again.popleft() if self._again else None

    def again(self, job: Job) -> None:
        """Puts a job that failed behind all others."""
        self._again.append(job)


@dataclass
class Summary:
    """What became of a batch. cpu, work: as of an Outcome, over all tries. peak: of the largest worker."""

    done: int = 0
    already: int = 0
    retried: int = 0
    bytes: int = 0
    seconds: float = 0.0
    cpu: float = 0.0
    work: float = 0.0
    peak: int = 0
    failures: list[dict[str, Any]] = field(default_factory=list)

    def json(self) -> dict[str, Any]:
        """Of builtins."""
        return {
            "done": self.done, "already": self.already, "failed": len(self.failures), "retried": self.retried,
            "bytes": self.bytes, "seconds": round(self.seconds, 3), "cpu_seconds": round(self.cpu, 3),
            "work_cpu_seconds": round(self.work, 3), "peak_memory": self.peak,
            "failures": self.failures,
        }  # fmt: skip


#: Told of every job that is over: its last outcome, and how often it was tried.
Told = Callable[[Job, Outcome, int], None]


def run(
    jobs: Iterator[Job], command: Command, engine: Engine, settings: EngineSettings, retries: int, told: Told
) -> Summary:
    """Runs all jobs; one that fails is tried again `retries` times, unless that would end the same."""
    summary, tries, begun = Summary(), Counter[int](), time.monotonic()
    feed = JobFeed(jobs)
    with closing(engine(partial(run_job, command=command), feed, settings)) as outcomes:
        for job, outcome in outcomes:
            summary.cpu += outcome.cpu
            summary.work += outcome.work
            summary.bytes += outcome.bytes
            summary.peak = max(summary.peak, outcome.peak)
            tries[job.line.number] += 1
            count = tries[job.line.number]
            if outcome.state == FAILED and not outcome.final and count <= retries:
                summary.retried += 1
                feed.again(job)
                continue
            del tries[job.line.number]  # of a million, only those under way are remembered
            summary.done += outcome.state == DONE
            summary.already += outcome.state == ALREADY
            told(job, outcome, count)
    summary.seconds = time.monotonic() - begun
    return summary
