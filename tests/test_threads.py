"""The policy of threads holds for numpy's BLAS: in a command, and while a library's call encodes."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def _run(code: str, **variables: str) -> list[str]:
    """The words that `code` prints in a process of its own, in which no number of threads is asked for."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "OPENBLAS_"))} | variables
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *sys.path[1:]])
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


COMMAND = """
import os, sys
from pd4dgs_codec.cli import common, options
def action(args, console):
    assert "numpy" not in sys.modules
    print(os.environ["OPENBLAS_NUM_THREADS"], os.environ["OMP_WAIT_POLICY"])
    return 0
parser = options.Parser("encode", "", "", "")
parser.add_common()
common.run(parser, action, [])
"""


def test_a_command_settles_the_policy_before_numpy_is_there():
    assert _run(COMMAND) == ["1", "passive"]
    assert _run(COMMAND, OPENBLAS_NUM_THREADS="2") == ["2", "passive"]  # a user's choice stays


LIBRARY = """
import sys
sys.path.append("tests")
import numpy
from threadpoolctl import threadpool_info
from strategies import make_scene
from pd4dgs_codec.format import encoder

def threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}

seen, check = [], encoder.check_scene
encoder.check_scene = lambda scene: (seen.append(threads()), check(scene))
before = threads()
encoder.encode(make_scene(3, anchors=12), effort=1)
assert seen == [{1}], seen
assert threads() == before
print(max(before))
"""


def test_encoding_keeps_the_blas_of_a_loaded_numpy_to_one_thread_meanwhile():
    pytest.importorskip("threadpoolctl")
    assert _run(LIBRARY, OPENBLAS_NUM_THREADS="2") == ["2"]
