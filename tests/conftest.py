"""What all tests share: one thread each, a Hypothesis profile without deadlines, and interrupts that arrive.

Workers of pytest-xdist take all cores, so that more threads would only wait for each other; tests of several threads
ask for them by number. The shell of a background job ignores SIGINT, and its children with it; tests that send it need
it heeded.
"""

import contextlib
import io
import json
import math
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read by numpy, torch and ours when they load

ROOT = Path(__file__).parents[1]
#: None is a package: `refdec` is one file that can be carried alone, and tools and benchmarks are commands.
sys.path[:0] = [str(ROOT / name) for name in ("tools", "spec", "benchmarks")]

#: Rooms that need the extra `train`; without it their tests are not even collected.
NEED_TRAIN = ["batch", "bench", "benchmarks", "cli", "data", "interchange", "model", "draw", "quality"]
NEED_TRAIN += ["stability", "train"]
NEED_FEW_KERNELS = ["entropy", "spec"]
collect_ignore = [] if find_spec("torch") and find_spec("numba") else NEED_TRAIN

settings.register_profile("pd4dgs", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("pd4dgs")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Each worker begins with a run of the tests in their order. The first worker compiles most kernels, which takes a
    minute; the next begins with rooms that need only those of the encoder, and finds the others compiled."""
    rooms = [item.path.relative_to(ROOT / "tests").parts[0] for item in items]
    free = [item for item, room in zip(items, rooms, strict=True) if room in NEED_FEW_KERNELS]
    others = [item for item, room in zip(items, rooms, strict=True) if room not in NEED_FEW_KERNELS]
    run = len(items) // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    items[:] = [*others[:run], *free, *others[run:]]


@contextlib.contextmanager
def locked(path: Path) -> Iterator[None]:
    """No two processes at once; where files have no locks, those that share nothing but time."""
    if os.name != "posix":
        yield
        return
    import fcntl

    with path.open("r" if path.exists() else "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Iterator[None]:
    """A module of tests is imported by one worker at a time: the first compiles it, with all that it imports, and the
    others find that in the caches of bytecode. All at once, each would compile all of it."""
    with locked(collector.path) if isinstance(collector, pytest.Module) else contextlib.nullcontext():
        return (yield)


@pytest.fixture(autouse=True, scope="session")
def _kernels_are_compiled_once() -> Iterator[None]:
    """A worker that needs a kernel which another one compiles waits for it, asleep, and loads it from numba's cache:
    two that compile the same one take as long on two cores, and the others wait for both."""
    if not find_spec("numba"):
        yield
        return
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compile, held = Dispatcher.compile, set()

    @contextlib.contextmanager
    def own(path: str) -> Iterator[None]:
        """The lock of a source file. Kernels of one file call those of others, never both ways: none waits for ever."""
        if path in held or not os.path.isfile(path):
            yield
            return
        with locked(Path(path)):
            held.add(path)
            try:
                yield
            finally:
                held.discard(path)

    def alone(self: Any, sig: Any) -> Any:
        cached = self.stats.cache_path is not None
        with global_compiler_lock, own(self.py_func.__code__.co_filename) if cached else contextlib.nullcontext():
            return compile(self, sig)

    Dispatcher.compile = alone
    yield
    Dispatcher.compile = compile


@pytest.fixture(autouse=True, scope="session")
def _heed_interrupts() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def kernel_threads() -> Iterator[Callable[[int], None]]:
    """Sets the number of threads of kernels until the test ends."""
    from pd4dgs_codec import threads

    before = threads.kernel_threads()
    yield threads.set_kernel_threads
    threads.set_kernel_threads(before)


@pytest.fixture(scope="session")
def python() -> Callable[..., str]:
    """python(code, *arguments, **variables) -> what the code prints in a process of its own, which must not fail."""

    def call(code: str, *arguments: object, **variables: str) -> str:
        command = [sys.executable, "-c", code, *map(str, arguments)]
        options: dict[str, Any] = {"capture_output": True, "text": True, "timeout": 300}
        done = subprocess.run(command, env=os.environ | variables, cwd=ROOT, **options)
        assert done.returncode == 0, done.stderr
        return done.stdout

    return call


@pytest.fixture(scope="session")
def once(tmp_path_factory) -> Callable[[str, Callable[[Path], object]], Path]:
    """once(name, make) -> a folder that make(folder) has filled, in one of all workers: what takes seconds to make and
    is only read. A fixture is made in each worker that has a test of it; those of one module go to several."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def call(name: str, make: Callable[[Path], object]) -> Path:
        folder, done = base / f"once-{name}", base / f"once-{name}.done"
        with locked(base / f"once-{name}.lock"):
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)  # of a try that failed
                folder.mkdir()
                make(folder)
                done.touch()
        return folder

    return call


@pytest.fixture(scope="session")
def missing() -> Callable[[object], Any]:
    """missing(reason) skips a test of a browser, and fails it where PD4DGS_REQUIRE_BROWSER is 1."""
    end = pytest.fail if os.environ.get("PD4DGS_REQUIRE_BROWSER") == "1" else pytest.skip
    return lambda reason: end(str(reason))


@pytest.fixture(scope="module")
def browser(missing) -> Iterator[Any]:
    """Chromium as Playwright sees it."""
    from browser import launched

    from pd4dgs_codec.errors import DataError

    try:
        with launched() as found:
            yield found
    except DataError as error:
        missing(error)


@dataclass(frozen=True)
class Result:
    """What a command did."""

    code: int
    out: bytes
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def error_lines(self) -> list[str]:
        return self.err.splitlines()


@pytest.fixture
def cli(capfdbinary, monkeypatch) -> Callable[..., Result]:
    """cli("info", path, "--json", stdin=b"...") -> Result. No command is so slow here that it tells of its progress."""
    monkeypatch.setattr("pd4dgs_codec.cli.common.LINE_SECONDS", math.inf)

    def call(verb: str, *argv: object, stdin: bytes | None = None) -> Result:
        if stdin is not None:
            stream = SimpleNamespace(buffer=io.BytesIO(stdin), isatty=lambda: False)
            monkeypatch.setattr("sys.stdin", stream)
        capfdbinary.readouterr()
        code = import_module(f"pd4dgs_codec.cli.{verb}").main([str(a) for a in argv])
        out, err = capfdbinary.readouterr()
        return Result(code, out, err.decode())

    return call
