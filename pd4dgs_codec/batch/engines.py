"""Who runs the jobs: a pool of processes on this machine, Ray, or Slurm through submitit.

An engine is a generator: it takes jobs from a feed as long as it has room, and yields each with its outcome. A worker
that died or took too long is an outcome too. Whether to try again is not the engine's business: the job comes back
through the feed.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterable
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, Protocol

from pd4dgs_codec.batch.job import FAILED, Job, Outcome
from pd4dgs_codec.errors import DataError

Work = Callable[[Job], Outcome]
POLL_SECONDS = 1.0  #: between looks at jobs whose end nothing tells
QUEUE_SECONDS = 30.0  #: between looks at Slurm's queue; a result on a shared disk may be seen later than its job's end
ARRAY = 1000  #: jobs of a Slurm array at most; its usual limit (MaxArraySize) is 1001


class Feed(Protocol):
    """Jobs to be done."""

    def take(self) -> Job | None:
        """The next one; None if there is none now. What fails later may come back."""


@dataclass(frozen=True)
class EngineSettings:
    """How an engine runs jobs.

    workers: jobs at a time; 0: in this process, one after the other. threads: CPUs of a job. gpus: of a job. timeout:
    seconds after which a job is ended, or None. address: of a Ray cluster. folder: for what Slurm's jobs say. slurm:
    parameters of submitit.
    """

    workers: int
    threads: int = 1
    gpus: float = 0
    timeout: float | None = None
    address: str | None = None
    folder: Path = Path("batch-logs")
    slurm: dict[str, str] = field(default_factory=dict)

    def late(self) -> Outcome:
        """Of a job that took too long."""
        return Outcome(FAILED, f"was ended after {self.timeout:g} s, the most that --timeout allows")


def lost(why: str) -> Outcome:
    """Of a job whose worker died."""
    return Outcome(FAILED, f"its worker was lost: {why}")


Outcomes = Generator[tuple[Job, Outcome], None, None]
Engine = Callable[[Work, Feed, EngineSettings], Outcomes]

# -- this machine ------------------------------------------------------------------------------------------------------


class _Worker:
    """A process that does one job after the other, and dies with its parent."""

    def __init__(self, work: Work):
        context = multiprocessing.get_context("spawn")  # OpenMP kills forked children
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        self.process.start()
        theirs.close()  # so that the end of the process ends the pipe
        self.job: Job | None = None
        self.begun = 0.0

    def begin(self, job: Job) -> None:
        self.job, self.begun = job, time.monotonic()
        with contextlib.suppress(OSError):  # a worker that died idle: the end of its pipe tells
            self.pipe.send(job)

    def end(self) -> tuple[Job, Outcome]:
        """The job in hand and its outcome, which has come; a pipe that ended is one."""
        job, self.job = self.job, None
        assert job is not None
        try:
            return job, self.pipe.recv()
        except (EOFError, OSError):
            self.process.join()
            code = self.process.exitcode or 0
            return job, lost(signal.Signals(-code).name if code < 0 else f"exit code {code}")

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


def _serve(pipe: Connection, work: Work) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent decides
    parent = multiprocessing.parent_process()
    assert parent is not None
    threading.Thread(target=lambda: (wait([parent.sentinel]), os._exit(1)), daemon=True).start()
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(work(job))


def local(work: Work, feed: Feed, settings: EngineSettings) -> Outcomes:
    """A pool of processes; with 0 workers this process alone, which nothing can end early."""
    if settings.workers == 0:
        while job := feed.take():
            yield job, work(job)
        return
    workers: list[_Worker] = []
    try:
        while True:
            for worker in [w for w in workers if w.job is None]:
                if job := feed.take():
                    worker.begin(job)
            while len(workers) < settings.workers and (job := feed.take()):
                workers.append(_Worker(work))
                workers[-1].begin(job)
            busy = [worker for worker in workers if worker.job is not None]
            if not busy:
                return
            ready = wait([worker.pipe for worker in busy], _patience(busy, settings))
            for worker in busy:
                if worker.pipe in ready:
                    job, outcome = worker.end()
                elif settings.timeout and time.monotonic() - worker.begun >= settings.timeout and worker.job:
                    job, outcome = worker.job, settings.late()
                    worker.kill()
                else:
                    continue
                if not worker.process.is_alive():
                    workers.remove(worker)
                yield job, outcome
    finally:
        for worker in workers:
            worker.kill()


def _patience(busy: list[_Worker], settings: EngineSettings) -> float | None:
    """Seconds until the next job is late."""
    if settings.timeout is None:
        return None
    return max(0.0, min(worker.begun for worker in busy) + settings.timeout - time.monotonic())


# -- Ray ---------------------------------------------------------------------------------------------------------------


def ray(work: Work, feed: Feed, settings: EngineSettings) -> Outcomes:
    """Tasks of Ray Core on the cluster at `address` (RAY_ADDRESS if None, else one on this machine)."""
    address = settings.address or os.environ.get("RAY_ADDRESS")
    _reach(address)
    import ray

    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except Exception as error:  # a bare one too, where a node does not come up
        raise DataError(f"Ray cannot be reached at {address or 'an address of its own'}: {error}") from None
    needed = {"CPU": settings.threads, "GPU": settings.gpus}
    if not any(_has(node, needed) for node in ray.nodes()):
        ray.shutdown()
        wanted = " and ".join(f"{count:g} {kind}" for kind, count in needed.items() if count)
        raise DataError(f"no node of the Ray cluster has the {wanted} that a scene takes")  # Ray would wait for one
    try:
        with contextlib.redirect_stdout(sys.stderr):  # Ray prints what became of its workers; stdout is for --json
            yield from _tasks(work, feed, settings)
    finally:
        ray.shutdown()


def _tasks(work: Work, feed: Feed, settings: EngineSettings) -> Outcomes:
    import ray

    # lost nodes and workers are outcomes: one bound for all retries
    task = ray.remote(num_cpus=settings.threads, num_gpus=settings.gpus, max_retries=0)(_call)
    running: dict[Any, tuple[Job, float]] = {}
    while True:
        room = settings.workers or int(ray.cluster_resources().get("CPU", 1) // settings.threads) or 1
        while len(running) < room and (job := feed.take()):
            running[task.remote(work, job)] = job, time.monotonic()
        if not running:
            return
        ready, _ = ray.wait(list(running), timeout=POLL_SECONDS if settings.timeout else None)
        for task_id in ready:
            job, _ = running.pop(task_id)
            try:
                outcome = ray.get(task_id)
            except ray.exceptions.RayError as error:
                outcome = lost(type(error).__name__)
            yield job, outcome
        for task_id, (job, begun) in list(running.items()):
            if settings.timeout and time.monotonic() - begun >= settings.timeout:
                ray.cancel(task_id, force=True)
                del running[task_id]
                yield job, settings.late()


def _has(node: dict[str, Any], needed: dict[str, float]) -> bool:
    return bool(node["Alive"]) and all(node["Resources"].get(kind, 0) >= count for kind, count in needed.items())


def _reach(address: str | None) -> None:
    """Sees that something listens at HOST:PORT: Ray itself tries for a quarter of an hour. Raises DataError."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if not (colon and port.isdecimal()):
        return  # auto, local, or none: Ray looks on this machine
    os.environ.setdefault("RAY_gcs_server_port_wait_time_s", "1")  # tries, of 40 s each, of what listens and is no Ray
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
    except (OSError, OverflowError) as error:
        raise DataError(f"no Ray cluster answers at {address}: {error}") from None


def _call(work: Work, job: Job) -> Outcome:
    """What Ray takes for a task: a function, where `work` may be any callable."""
    return work(job)


# -- Slurm -------------------------------------------------------------------------------------------------------------


def slurm(work: Work, feed: Feed, settings: EngineSettings) -> Outcomes:
    """Array jobs of Slurm, through submitit; `cluster=local` in `slurm` runs them as processes of this machine."""
    import submitit

    parameters: dict[str, Any] = dict(settings.slurm)
    cluster = parameters.pop("cluster", "slurm")
    try:
        executor = submitit.AutoExecutor(folder=settings.folder, cluster=cluster)
        parameters |= {"cpus_per_task": settings.threads, "name": "pd4dgs-batch"}
        if settings.timeout:
            parameters["timeout_min"] = max(1, round(settings.timeout / 60))
        if settings.gpus:
            parameters["gpus_per_node"] = int(settings.gpus)
        if settings.workers and cluster == "slurm":
            parameters["slurm_array_parallelism"] = settings.workers
        executor.update_parameters(**parameters)
    except (RuntimeError, ValueError, TypeError, NameError) as error:
        raise DataError(f"submitit takes no such jobs: {error}") from None
    room = ARRAY if cluster == "slurm" else settings.workers or 1
    running: dict[str, tuple[Any, Job]] = {}
    looked, gone = time.monotonic(), set[str]()
    try:
        while True:
            jobs: list[Job] = []
            while len(running) + len(jobs) < room and (job := feed.take()):
                jobs.append(job)
            running |= {task.job_id: (task, job) for task, job in zip(_array(executor, work, jobs), jobs, strict=True)}
            if not running:
                return
            ended = [number for number, (task, _) in running.items() if task.done()]
            for number in ended:
                task, job = running.pop(number)
                try:
                    outcome = task.result()
                except Exception as error:  # submitit has several for jobs that ended without a result
                    outcome = lost(type(error).__name__)
                yield job, outcome
            if cluster == "slurm" and time.monotonic() - looked >= QUEUE_SECONDS:
                before, gone, looked = gone, set(running) - _queued(running), time.monotonic()
                for number in before & gone:
                    yield running.pop(number)[1], lost("Slurm has it no more, and it left no result")
            elif not ended:
                time.sleep(POLL_SECONDS)
    finally:
        for task, _ in running.values():
            task.cancel()


def _queued(running: Iterable[str]) -> set[str]:
    """Which jobs wait or run. submitit asks sacct alone, which knows of none where a site keeps no accounts."""
    command = ["squeue", "--noheader", "--array", "--me", "--format=%i"]
    try:
        return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())
    except (OSError, subprocess.CalledProcessError):
        return set(running)  # who does not answer has lost none


def _array(executor: Any, work: Work, jobs: list[Job]) -> list[Any]:
    if not jobs:
        return []
    try:
        with executor.batch():
            tasks = [executor.submit(work, job) for job in jobs]
    except RuntimeError as error:
        raise DataError(f"Slurm takes no jobs: {error}") from None
    return tasks


ENGINES: dict[str, Engine] = {"local": local, "ray": ray, "slurm": slurm}
