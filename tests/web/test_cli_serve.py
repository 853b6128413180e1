"""`pd4dgs-serve` as its users start and stop it; wrong options are cases of tests/cli/test_bad_input.py."""

import json
import signal
import subprocess
import sys
import urllib.request

import pytest


def start(*argv: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pd4dgs_codec", "serve", *map(str, argv)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_first_line_is_the_url_and_a_signal_ends_it(folder, number):
    process = start(folder, "--port", 0, "-v")
    url = process.stdout.readline().strip()
    with urllib.request.urlopen(url + "bytes.bin", timeout=10) as response:
        assert len(response.read()) == 1000
    process.send_signal(number)
    out, err = process.communicate(timeout=10)
    assert process.returncode == 0 and out == "" and "GET /bytes.bin" in err


def test_json_rate_and_latency(folder):
    process = start(folder, "--port", 0, "--rate", "500k", "--latency", "20ms", "--json")
    told = json.loads(process.stdout.readline())
    process.terminate()
    process.communicate(timeout=10)
    assert told["url"].startswith("http://127.0.0.1:") and told["rate"] == 5e5 and told["latency"] == 0.02
