"""`pd4dgs-serve` as its users start and stop it."""

import json
import signal
import subprocess
import sys
import urllib.request
from importlib import import_module

import pytest


def start(*argv: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pd4dgs_codec", "serve", *map(str, argv)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_first_line_is_the_url_and_a_signal_ends_it(folder, number):
    process = start(folder, "--port", 0, "-v")
    assert process.stdout is not None
    url = process.stdout.readline().strip()
    with urllib.request.urlopen(url + "bytes.bin", timeout=10) as response:
        assert len(response.read()) == 1000
    process.send_signal(number)
    out, err = process.communicate(timeout=10)
    assert process.returncode == 0 and out == "" and "GET /bytes.bin" in err


def test_json_rate_and_latency(folder):
    process = start(folder, "--port", 0, "--rate", "500k", "--latency", "20ms", "--json")
    assert process.stdout is not None
    told = json.loads(process.stdout.readline())
    process.terminate()
    process.communicate(timeout=10)
    assert told["url"].startswith("http://127.0.0.1:") and told["rate"] == 5e5 and told["latency"] == 0.02


@pytest.mark.parametrize(
    ("options", "code"),
    [
        (["--port", "65536"], 2),
        (["--port", "-1"], 2),
        (["--rate", "2X"], 2),
        (["--rate", "0"], 2),
        (["--rate", "nan"], 2),
        (["--latency", "-1ms"], 2),
        (["--host", ""], 2),
        (["--host", "203.0.113.77", "--port", "0"], 1),
    ],
)
def test_options_that_cannot_work_are_one_line(folder, capsys, options, code):
    assert import_module("pd4dgs_codec.cli.serve").main([str(folder), *options]) == code
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1 and err.startswith("pd4dgs-serve: error: ")


def test_a_folder_that_is_none(folder, capsys):
    assert import_module("pd4dgs_codec.cli.serve").main([str(folder / "bytes.bin"), "--port", "0"]) == 1
    assert "is not a folder" in capsys.readouterr().err
