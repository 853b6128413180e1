"""200 small scenes through `pd4dgs-batch` under faults. Writes the table of docs/batch.md.

    python tools/batch.py [--only NAME ...] [--scenes 200] [--out out] [--docs docs] [--render]

Needs the extra `cluster`, and for the row s3 moto[server] and s3fs. Every row is compared with the first, one process
that does one scene after the other.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import flaky
from pages.page import ROOT, Page, Row, make, options, paragraph, unpadded

from pd4dgs_codec.bench.report import markdown
from pd4dgs_codec.errors import DataError

TICK = os.sysconf("SC_CLK_TCK")
RECORD = ".done.json"
POLL_SECONDS = 0.2

#: What each row does beside encoding all scenes.
CASES = {
    "serial": "one process, no pool",
    "local": "two processes",
    "local, worker killed": "two processes, one killed (SIGKILL) at a third",
    "local, killed and resumed": "the whole batch killed (SIGKILL) in the middle, then begun again",
    "local, flaky store": "two processes, a store that fails one call in ten",
    "s3": "two processes, sources and outputs on an S3 server",
    "ray": "a head and two nodes of one core each",
    "ray, worker and node killed": "a head and two nodes; a worker killed (SIGKILL) at a third, a node at two thirds",
    "ray, killed and resumed": "a head and two nodes; the batch killed in the middle, then begun again",
    "ray, flaky store": "a head and two nodes, a store that fails one call in ten",
    "slurm": "submitit's local executor, two at a time, a process per scene; 8 scenes",
}


def scenes(folder: Path, count: int) -> None:
    """Checkpoints of untrained models of a few hundred anchors, each of another seed."""
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
    from pd4dgs_codec.scene import GLOBAL_HEADS, LOCAL_HEADS
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.initialise import fresh_model

    if len(list(folder.glob("*.pt"))) >= count:
        return
    folder.mkdir(parents=True, exist_ok=True)
    size = ModelConfig(
        DeformationConfig(4, 4, 4, (1,), 8, GLOBAL_HEADS),
        DeformationConfig(4, 4, 4, (1,), 8, tuple(LOCAL_HEADS)),
        hidden=8, initial_anchors=600, max_anchors=600,
    )  # fmt: skip
    dataset, config = load("synthetic:static", downscale=8), TrainConfig(preset="tiny")
    for seed in range(count):
        model = fresh_model(size, dataset, config.widths, config.model_steps(size.steps), seed, 2)
        checkpoint.save(folder / f"{seed:03d}.pt", model)


# -- processes ---------------------------------------------------------------------------------------------------------


def processes() -> dict[int, tuple[int, float, int]]:
    """Process -> (its parent, CPU seconds with those of its children that ended, resident bytes)."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            spent = sum(map(int, fields[11:15])) / TICK
            found[int(entry.name)] = int(fields[1]), spent, int(fields[21]) * os.sysconf("SC_PAGE_SIZE")
    return found


def family(root: int, table: dict[int, tuple[int, float, int]]) -> list[int]:
    """A process and all that descend from it."""
    found, new = [], [root] if root in table else []
    while new:
        found += new
        new = [number for number, (parent, _, _) in table.items() if parent in new]
    return found


@contextmanager
def started(command: Sequence[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """A process with a group of its own, which is killed at the end."""
    quiet = subprocess.DEVNULL
    process = subprocess.Popen(command, env=environment, stdout=quiet, stderr=quiet, start_new_session=True)
    try:
        yield process
    finally:
        for number in family(process.pid, processes()):
            try:
                os.kill(number, signal.SIGKILL)
            except ProcessLookupError:
                continue
        process.wait()


def free_port() -> int:
    """A port of the loopback that nothing listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Batch:
    """A run of `pd4dgs-batch`, watched: CPU seconds and memory of it and of `others`, which it uses."""

    def __init__(self, argv: Sequence[str], folder: Path, environment: dict[str, str], others: Sequence[int] = ()):
        command = [sys.executable, "-m", "pd4dgs_codec", "batch", *argv, "--json", "--logs", str(folder / "logs")]
        self.output = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the run
        self.process = subprocess.Popen(
            command, env=environment, cwd=folder, stdout=self.output, stderr=subprocess.DEVNULL
        )
        self.others, self.before = others, processes()
        self.memory: list[int] = []
        self.spent = 0.0

    def watch(self, done: Callable[[], int], at: dict[int, Callable[[], None]]) -> dict[str, Any]:
        """Waits for the end; at so many finished scenes calls what `at` says. Returns the summary."""
        while self.process.poll() is None:
            time.sleep(POLL_SECONDS)
            self._look()
            for number in [n for n in at if done() >= n]:
                at.pop(number)()
        self._look()
        self.output.seek(0)
        text = self.output.read()
        summary = dict(json.loads(text)) if text.strip() else {}
        if "error" in summary:
            raise DataError(summary["error"]["message"])
        return summary

    def _look(self) -> None:
        table = processes()
        own = family(self.process.pid, table)
        rest = [number for root in self.others for number in family(root, table) if number not in own]
        if self.process.returncode is None and own:
            self.memory.append(sum(table[n][2] for n in [*own, *rest]))
            begun = sum(self.before[n][1] for n in rest if n in self.before)
            self.spent = max(self.spent, sum(table[n][1] for n in [*own, *rest]) - begun)


# -- cases -------------------------------------------------------------------------------------------------------------


def measure(name: str, count: int, out: Path) -> Row:
    """The row of a case."""
    folder = out / "batch"
    scenes(folder / "models", count)
    if name == "slurm":
        count = 8
    with tempfile.TemporaryDirectory() as temporary, ExitStack() as stack:
        work = Path(temporary)
        path = f"{ROOT}:{flaky.python_path(work / 'flaky')}"
        environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
        sources, target, disk = str(folder / "models"), str(work / "out"), work / "out"
        argv, others = ["--workers", "0" if name == "serial" else "2"], []
        if "flaky" in name:
            target = f"flaky://{target}"
        if name == "s3":
            sources, target = _s3(stack, environment, folder / "models", count)
        if name.startswith("ray"):
            others, address = _cluster(stack, environment)
            argv = ["--on", "ray", "--address", address]
        if name == "slurm":
            argv += ["--on", "slurm", "--slurm", "cluster=local"]
        manifest = work / "scenes.jsonl"
        names = [f"{number:03d}" for number in range(count)]
        manifest.write_text("".join(json.dumps({"source": f"{sources}/{n}.pt"}) + "\n" for n in names))
        argv = [str(manifest), "--op", "encode", "-o", target, "-j", "2", "--cpus", "1", *argv]

        def done() -> int:
            return len(list(disk.glob(f"*{RECORD}"))) if disk.is_dir() else 0

        begun = time.perf_counter()
        batch = Batch(argv, work, environment, others)
        at, at_kill = _faults(name, count, batch, others, done), 0
        summary = batch.watch(done, at)
        if "resumed" in name:
            at_kill = done()
            batch = Batch(argv, work, environment, others)
            summary = batch.watch(done, {})
        seconds = time.perf_counter() - begun
        digests = _digests(target, environment) if name == "s3" else {p.name: _sha(p) for p in disk.glob("*.pd4")}
    reference = folder / "serial.json"
    if name == "serial":
        reference.write_text(json.dumps(digests))
    wanted = json.loads(reference.read_text())
    third = max(1, len(batch.memory) // 3)
    return {
        "scenes": count,
        "finished_before": at_kill,
        **{key: summary[key] for key in ("done", "already", "failed", "retried")},
        "same": digests == {f"{n}.pd4": wanted[f"{n}.pd4"] for n in names},
        "seconds": seconds,
        "work": summary["work_cpu_seconds"],
        "in_job": summary["cpu_seconds"],
        "cpu": batch.spent,
        "memory": [max(batch.memory[third : 2 * third], default=0), max(batch.memory[2 * third :], default=0)],
    }


def warm(out: Path) -> None:
    """Encodes one scene: numba compiles once per machine, which is no scene's work."""
    models = out / "batch" / "models"
    scenes(models, 1)
    with tempfile.TemporaryDirectory() as temporary:
        command = [sys.executable, "-m", "pd4dgs_codec", "encode", str(models / "000.pt"), "-o", f"{temporary}/0.pd4"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)


def _faults(
    name: str, count: int, batch: Batch, others: Sequence[int], done: Callable[[], int]
) -> dict[int, Callable[[], None]]:
    """What happens at which number of finished scenes."""

    def kill_worker() -> None:
        table = processes()
        roots = others or [batch.process.pid]
        workers = [n for root in roots for n in family(root, table) if _is_worker(n)]
        os.kill(max(workers, key=lambda n: table[n][1]), signal.SIGKILL)

    def kill_batch() -> None:
        for number in family(batch.process.pid, processes()):
            os.kill(number, signal.SIGKILL)

    def kill_node() -> None:
        for number in family(others[-1], processes()):
            os.kill(number, signal.SIGKILL)

    if "resumed" in name:
        return {count // 2: kill_batch}
    if "killed" in name:
        return {count // 3: kill_worker} | ({2 * count // 3: kill_node} if "node" in name else {})
    return {}


def _is_worker(number: int) -> bool:
    line = Path(f"/proc/{number}/cmdline").read_bytes()
    return b"spawn_main" in line or line.startswith(b"ray::")


NODE_TRIES = 5  #: Ray gives a node 30 s to start, which nothing raises; a busy machine may take longer
#: Ports that nodes on one machine must not share.
OWN_PORTS = ("dashboard-agent-listen", "dashboard-agent-grpc", "runtime-env-agent", "metrics-export")
#: Waits until a Ray cluster has so many cores.
JOINED = """
import ray, sys, time
begun = time.monotonic()
while time.monotonic() - begun < 60:
    try:
        ray.init(sys.argv[1], log_to_driver=False, logging_level="ERROR", ignore_reinit_error=True)
        if ray.cluster_resources().get("CPU", 0) >= int(sys.argv[2]):
            sys.exit(0)
    except ConnectionError:
        pass
    time.sleep(0.5)
sys.exit(1)
"""


def _cluster(stack: ExitStack, environment: dict[str, str]) -> tuple[list[int], str]:
    """(processes of a head without cores and of two nodes with one each, address)."""
    ray, port = str(Path(sys.executable).with_name("ray")), free_port()
    environment |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}  # nobody else's cluster
    environment |= {"RAY_agent_register_timeout_ms": "300000"}  # a busy machine starts a node's agents late
    common = ["--block", "--disable-usage-stats", "--object-store-memory", "100000000"]
    head = [ray, "start", "--head", f"--port={port}", "--num-cpus=0", "--include-dashboard=false", *common]
    address = f"127.0.0.1:{port}"
    numbers = [_joined(stack, head, environment, address, 0)]
    for count in (1, 2):  # one after the other: two that begin at once take each other's ports
        ports = [f"--min-worker-port={20_000 + 1000 * count}", f"--max-worker-port={20_999 + 1000 * count}"]
        node = [ray, "start", f"--address={address}", "--num-cpus=1", *ports, *common]
        numbers.append(_joined(stack, node, environment, address, count))
    return numbers, address


def _joined(stack: ExitStack, command: Sequence[str], environment: dict[str, str], address: str, cores: int) -> int:
    """The process of a Ray node, with which the cluster at `address` has so many cores."""
    wait = [sys.executable, "-c", JOINED, address, str(cores)]
    once = environment | {"RAY_gcs_server_port_wait_time_s": "1"}  # else it tries for a quarter of an hour
    for _ in range(NODE_TRIES):
        ports = [f"--{name}-port={free_port()}" for name in OWN_PORTS]
        with ExitStack() as tried:
            process = tried.enter_context(started([*command, *ports], environment))
            if subprocess.run(wait, env=once).returncode == 0 and process.poll() is None:
                stack.push(tried.pop_all())
                return process.pid
    raise DataError(f"the Ray cluster did not come to {cores} cores")


def _wait_for(port: int) -> None:
    for _ in range(300):
        try:
            socket.create_connection(("127.0.0.1", port), timeout=1).close()
            return
        except OSError:
            time.sleep(0.2)
    sys.exit(f"nothing listens on port {port}")


def _s3(stack: ExitStack, environment: dict[str, str], models: Path, count: int) -> tuple[str, str]:
    """(where the sources are, where outputs go) on a server of moto's; the environment says where that is."""
    port = free_port()
    environment |= {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}", "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }  # fmt: skip
    server = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    stack.enter_context(started(server, environment))
    _wait_for(port)
    program = (
        "import fsspec, sys, pathlib\n"
        "s3 = fsspec.filesystem('s3')\ns3.mkdir('library')\n"
        "for p in sorted(pathlib.Path(sys.argv[1]).glob('*.pt'))[: int(sys.argv[2])]:\n"
        "    s3.put_file(str(p), f'library/models/{p.name}')\n"
    )
    subprocess.run([sys.executable, "-c", program, str(models), str(count)], env=environment, check=True)
    return "s3://library/models", "s3://library/out"


def _digests(target: str, environment: dict[str, str]) -> dict[str, str]:
    program = (
        "import fsspec, sys, hashlib, json\n"
        "fs, path = fsspec.core.url_to_fs(sys.argv[1])\n"
        "names = [n for n in fs.find(path) if n.endswith('.pd4')]\n"
        "print(json.dumps({n.rpartition('/')[2]: hashlib.sha256(fs.cat_file(n)).hexdigest() for n in names}))"
    )
    done = subprocess.run([sys.executable, "-c", program, target], env=environment, check=True, capture_output=True)
    return dict(json.loads(done.stdout))


def _sha(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


# -- the page ----------------------------------------------------------------------------------------------------------


def _done(row: Row) -> str:
    before, found = row["finished_before"], row["already"] - row["finished_before"]
    parts = [f"{before}"] if before else []
    return " + ".join([*parts, f"{row['done']}", *([f"{found} found"] if found else [])])


def render(rows: Sequence[Row]) -> str:
    """A line per case."""
    cells = [
        (
            row["name"],
            CASES[row["name"]],
            _done(row),
            row["retried"],
            row["failed"],
            "yes" if row["same"] else "no",
            f"{row['work'] / row['done']:.2f}",
            f"{100 * (row['in_job'] - row['work']) / row['work']:.1f} %",
            "" if "node" in row["name"] else f"{100 * (row['cpu'] - row['work']) / row['work']:.1f} %",
            " → ".join(f"{value / 1e6:.0f}" for value in row["memory"]),
        )
        for row in rows
    ]
    head = ("case", "what happens", "done", "tried again", "failed", "same bytes", "work s", "in job", "in all", "MB")
    text = paragraph(
        "*done*: scenes encoded; before the kill and after it, where there was one; *found*: finished, though the "
        "worker died before it could say so. *work s*: CPU seconds of `pd4dgs-encode` per scene. *in job*: CPU time of "
        "a scene's job beside that. *in all*: CPU time of all processes beside that: starting interpreters, importing "
        "torch's files, the driver, Ray's own; a node that was killed takes its count along. *MB*: most memory of all "
        "processes together in the second and in the last third of the run."
    )
    table = markdown(head, [[str(cell) for cell in row] for row in cells])
    return "\n".join([unpadded(table), "", *text])


PAGE = Page("batch", "batch.py", render)


def main() -> int:
    """Entry point; returns the exit code."""
    parser = options(__doc__, tuple(CASES))
    parser.add_argument("--scenes", type=int, default=200, metavar="N", help="how many (200)")
    args = parser.parse_args()
    todo = args.only or list(CASES)
    out = args.out.resolve()
    if not args.render:
        warm(out)
    return make(PAGE, tuple(CASES), todo, args, lambda name: measure(name, args.scenes, out))


if __name__ == "__main__":
    sys.exit(main())
