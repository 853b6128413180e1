"""Runs the jobs of a batch on an engine, retries failed ones and sums up the results.

An engine is a pool of processes on this machine, Ray, or Slurm through submitit. All share the loop and the retries;
Slurm enforces the time limit itself.
"""

import contextlib
import math
import multiprocessing
import os
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from pd4dgs_codec.batch.job import ALREADY, DONE, FAILED, Command, Job, Outcome, run_job
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.io import remove_temporaries
from pd4dgs_codec.signals import follow_parent

Work = Callable[[Job], Outcome]
GRACE_SECONDS = 5.0  #: for a process to clean up before it is killed
POLL_SECONDS = 1.0  #: between looks at Slurm's results
MAX_ARRAY = 1000  #: jobs of a Slurm array; the usual limit (MaxArraySize) is 1001


@dataclass(frozen=True)
class Settings:
    """How an engine runs jobs.

    workers: jobs at a time; 0: locally in this process, on Ray as many as fit. threads: CPUs of a job. gpus: of a job.
    timeout: seconds after which a job is ended, or None. address: of a Ray cluster. folder: for the logs of Slurm jobs.
    slurm: parameters of submitit.
    """

    workers: int
    threads: int = 1
    gpus: float = 0
    timeout: float | None = None
    address: str | None = None
    folder: Path = Path("batch-logs")
    slurm: dict[str, str] = field(default_factory=dict)


class Engine:
    """Runs jobs. room: how many at a time; timeout: seconds after which `run` ends a job, None if it never does."""

    room = 1
    timeout: float | None = None

    def start(self, jobs: list[Job]) -> list[Future[Outcome]]:
        """Starts jobs. The future of a job whose worker was lost has an exception."""
        raise NotImplementedError

    def kill(self, future: Future[Outcome]) -> None:
        """Ends a job."""

    def close(self) -> None:
        """Ends all jobs."""


def run(
    jobs: Iterable[Job],
    command: Command,
    on: str,
    settings: Settings,
    retries: int,
    report: Callable[[Job, Outcome, int], None],
) -> dict[str, Any]:
    """Runs all jobs on an engine: "local", "ray" or "slurm".

    A failed job is retried up to `retries` times, behind all others, unless its failure is final. report: called with
    each finished job, its last outcome and its number of tries. Raises DataError if the engine cannot run.

    Returns numbers for the command's JSON: counts of lines, and over all tries bytes, CPU seconds (work: of the
    commands alone) and the largest memory of a worker, bytes.
    """
    summary: dict[str, Any] = dict.fromkeys(("done", "already", "retried", "bytes", "peak_memory"), 0)
    summary |= dict.fromkeys(("seconds", "cpu_seconds", "work_cpu_seconds"), 0.0)
    tries, begun = Counter[int](), time.monotonic()
    waiting, engine = deque(jobs), ENGINES[on](partial(run_job, command=command), settings)
    with contextlib.closing(engine):
        for job, outcome in _outcomes(engine, waiting):
            summary["cpu_seconds"] += outcome.cpu
            summary["work_cpu_seconds"] += outcome.work
            summary["bytes"] += outcome.bytes
            summary["peak_memory"] = max(summary["peak_memory"], outcome.peak)
            tries[job.line.number] += 1
            if outcome.state == FAILED and not outcome.final and tries[job.line.number] <= retries:
                summary["retried"] += 1
                waiting.append(job)
                continue
            if outcome.state in (DONE, ALREADY):
                summary[outcome.state] += 1
            report(job, outcome, tries[job.line.number])
    summary["seconds"] = time.monotonic() - begun
    return {key: round(value, 3) if isinstance(value, float) else value for key, value in summary.items()}


def _outcomes(engine: Engine, waiting: deque[Job]) -> Iterator[tuple[Job, Outcome]]:
    """Yields each job with its outcome as it ends, until none waits or runs."""
    running: dict[Future[Outcome], tuple[Job, float]] = {}
    while True:
        new = [waiting.popleft() for _ in range(min(len(waiting), engine.room - len(running)))]
        running |= {future: (job, time.monotonic()) for future, job in zip(engine.start(new), new, strict=True)}
        if not running:
            return
        patience, limit = None, engine.timeout
        if limit:
            patience = max(0.0, min(begun for _, begun in running.values()) + limit - time.monotonic())
        for future in wait(running, patience, FIRST_COMPLETED).done:
            error = future.exception()
            why = f"the worker process was lost: {type(error).__name__}: {error}"
            yield running.pop(future)[0], future.result() if error is None else Outcome(FAILED, why)
        for future, (job, begun) in list(running.items()):
            if limit and time.monotonic() - begun >= limit:
                engine.kill(future)
                del running[future]
                yield job, Outcome(FAILED, f"stopped after {limit:g} s (--timeout)")


# -- this machine ------------------------------------------------------------------------------------------------------


class Local(Engine):
    """Runs jobs in pools of one process, since a process that dies breaks its pool; with 0 workers, in this process."""

    def __init__(self, work: Work, settings: Settings):
        self.work, self.inline, self.timeout = work, settings.workers == 0, settings.timeout
        self.room = settings.workers or 1
        self.folder = tempfile.TemporaryDirectory(prefix="pd4dgs-batch-", ignore_cleanup_errors=True)
        self.pools: list[tuple[ProcessPoolExecutor, Future[int]]] = []
        self.busy: dict[Future[Outcome], tuple[ProcessPoolExecutor, Future[int]]] = {}

    def start(self, jobs: list[Job]) -> list[Future[Outcome]]:
        """Starts jobs in this process, in free pools, or in new ones."""
        self.busy = {future: pool for future, pool in self.busy.items() if not future.done()}
        return [self._begun(job) for job in jobs]

    def _begun(self, job: Job) -> Future[Outcome]:
        if self.inline:
            future = Future[Outcome]()
            future.set_result(self.work(job))
            return future
        pool = next((pool for pool in self.pools if pool not in self.busy.values()), None)
        if pool is None:  # OpenMP forbids fork
            executor = ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _follow_parent, (self.folder.name,))
            self.pools.append(pool := (executor, executor.submit(os.getpid)))
        try:
            future = pool[0].submit(self.work, job)
        except BrokenProcessPool:  # it died while it was free
            self.pools.remove(pool)
            return self._begun(job)
        self.busy[future] = pool
        return future

    def kill(self, future: Future[Outcome]) -> None:
        self._end([future])

    def _end(self, futures: list[Future[Outcome]]) -> None:
        """Ends jobs by SIGTERM, on which they remove partial files, and after GRACE_SECONDS by SIGKILL."""
        pools = {future: self.busy.pop(future) for future in futures}
        for number, patience in ((signal.SIGTERM, GRACE_SECONDS), (signal.SIGKILL, 0.0)):
            for future in (future for future in futures if not future.done()):
                with contextlib.suppress(BrokenProcessPool, ProcessLookupError):
                    os.kill(pools[future][1].result(), number)
            wait(futures, patience)
        for pool in pools.values():
            self.pools.remove(pool)
            pool[0].shutdown(wait=False, cancel_futures=True)

    def close(self) -> None:
        """Ends busy processes and shuts down the others."""
        self._end([future for future in self.busy if not future.done()])
        for executor, _ in self.pools:
            executor.shutdown(wait=False)
        self.folder.cleanup()


def _follow_parent(folder: str) -> None:
    """Prepares a worker. If it or its parent is killed, the other removes `folder`, which holds the worker's temporary
    files."""
    tempfile.tempdir = folder

    def clean() -> None:
        remove_temporaries()
        shutil.rmtree(folder, ignore_errors=True)

    follow_parent(clean)


# -- Ray ---------------------------------------------------------------------------------------------------------------


class Ray(Engine):
    """Runs jobs as Ray Core tasks on the cluster at `address` (None: RAY_ADDRESS, else a new one on this machine)."""

    def __init__(self, work: Work, settings: Settings):
        address = settings.address or os.environ.get("RAY_ADDRESS")
        _check_listens(address)
        import ray

        self.ray, self.work, self.timeout = ray, work, settings.timeout
        try:
            ray.init(address=address, log_to_driver=False, logging_level="ERROR")
        except Exception as error:  # of many kinds
            raise DataError(f"cannot connect to Ray ({address or 'a new local cluster'}): {error}") from None
        needed = {"CPU": settings.threads, "GPU": settings.gpus}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(all(node.get(kind, 0) >= count for kind, count in needed.items()) for node in nodes):
            ray.shutdown()
            wanted = " and ".join(f"{count:g} {kind}" for kind, count in needed.items() if count)
            raise DataError(
                f"found no node of the Ray cluster with the {wanted} that a scene needs"
            )  # Ray would wait for one
        self.room = settings.workers or int(ray.cluster_resources().get("CPU", 1) // settings.threads) or 1
        # `run` retries lost jobs itself, with one limit for all retries
        self.task = ray.remote(num_cpus=settings.threads, num_gpus=settings.gpus, max_retries=0)(_call)
        self.references: dict[Future[Outcome], Any] = {}
        self.quiet = contextlib.ExitStack()
        self.quiet.enter_context(contextlib.redirect_stdout(sys.stderr))  # Ray prints dead workers; stdout is for JSON

    def start(self, jobs: list[Job]) -> list[Future[Outcome]]:
        started = {(reference := self.task.remote(self.work, job)).future(): reference for job in jobs}
        self.references |= started
        return list(started)

    def kill(self, future: Future[Outcome]) -> None:
        self.ray.cancel(self.references[future], force=True)

    def close(self) -> None:
        self.ray.shutdown()
        self.quiet.close()


def _call(work: Work, job: Job) -> Outcome:
    """Calls `work`, which may be any callable, while a Ray task must be a function."""
    return work(job)


def _check_listens(address: str | None) -> None:
    """Raises DataError if nothing listens at HOST:PORT: Ray itself would try for a quarter of an hour."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if not (colon and port.isdecimal()):
        return  # auto, local, or none: Ray looks on this machine
    os.environ.setdefault("RAY_gcs_server_port_wait_time_s", "1")  # tries of 40 s each at a listener that is not Ray
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
    except (OSError, OverflowError) as error:
        raise DataError(f"cannot connect to Ray at {address}: {error}") from None


# -- Slurm -------------------------------------------------------------------------------------------------------------


class Slurm(Engine):
    """Submits array jobs to Slurm through submitit; Slurm enforces the time limit. `cluster=local` in `slurm` runs them
    as processes of this machine."""

    def __init__(self, work: Work, settings: Settings):
        import submitit

        parameters: dict[str, Any] = {"cpus_per_task": settings.threads, "name": "pd4dgs-batch", **settings.slurm}
        cluster = parameters.pop("cluster", "slurm")
        if settings.timeout:
            parameters["timeout_min"] = math.ceil(settings.timeout / 60)
        if settings.gpus:
            parameters["gpus_per_node"] = math.ceil(settings.gpus)
        if settings.workers and cluster == "slurm":
            parameters["slurm_array_parallelism"] = settings.workers
        try:
            self.executor = submitit.AutoExecutor(folder=settings.folder, cluster=cluster)
            self.executor.update_parameters(**parameters)
        except (RuntimeError, ValueError, TypeError, NameError) as error:
            raise DataError(f"submitit refused the settings: {error}") from None
        self.work, self.room = work, MAX_ARRAY if cluster == "slurm" else settings.workers or 1
        self.tasks: dict[Future[Outcome], Any] = {}
        threading.Thread(target=self._watch, daemon=True).start()

    def start(self, jobs: list[Job]) -> list[Future[Outcome]]:
        if not jobs:
            return []
        try:
            with self.executor.batch():
                tasks = [self.executor.submit(self.work, job) for job in jobs]
        except RuntimeError as error:
            raise DataError(f"Slurm refused the jobs: {error}") from None
        started = {Future[Outcome](): task for task in tasks}
        self.tasks |= started
        return list(started)

    def _watch(self) -> None:
        """Sets the outcome or the exception of each future as soon as submitit has it."""
        while True:
            for future, task in list(self.tasks.items()):
                try:
                    if not task.done():
                        continue
                    future.set_result(task.result())
                except Exception as error:  # submitit has several for jobs without a result
                    future.set_exception(error)
                del self.tasks[future]
            time.sleep(POLL_SECONDS)

    def close(self) -> None:
        for task in list(self.tasks.values()):
            task.cancel()


ENGINES: dict[str, Callable[[Work, Settings], Engine]] = {"local": Local, "ray": Ray, "slurm": Slurm}
