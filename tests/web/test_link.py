"""S bytes take 8S/B seconds over a link of B bits per second: alone, shared and after pauses.

The clock moves only while the link sleeps. The slow tests measure real time, within max(3 %, 10 ms).
"""

import contextlib
import statistics
import time
from types import SimpleNamespace

import pytest
from faulty import ask

from pd4dgs_codec.web import server as server_module
from pd4dgs_codec.web.server import CATCH_UP_SECONDS, Link, Server

RATES = [(2e6, 30_000), (10e6, 200_000), (50e6, 800_000)]


class Clock:
    """Stands in for the module `time`."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        assert seconds > 0
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(server_module, "time", clock)
    return clock


def cross(link: Link, size: int) -> None:
    """As the server does: block by block."""
    for start in range(0, size, link.block):
        link.cross(min(link.block, size - start))


@pytest.mark.parametrize(("rate", "size"), RATES)
def test_a_file_takes_8S_over_B(clock, rate, size):
    link = Link(rate)
    assert 8 * link.block / rate <= 0.005, "blocks are short against what is measured"
    start = clock.now
    with link.transfer():
        cross(link, size)
    assert clock.now - start == pytest.approx(8 * size / rate)


def test_a_waking_that_is_late_does_not_add_up(clock, monkeypatch):
    monkeypatch.setattr(clock, "sleep", lambda seconds: setattr(clock, "now", clock.now + seconds + 0.001))
    link, start = Link(2e6), clock.now
    with link.transfer():
        cross(link, 30_000)
    assert 0 <= clock.now - start - 8 * 30_000 / 2e6 <= 0.00101


def test_all_transfers_share_one_link(clock):
    link, ends = Link(4e6), []
    start = clock.now
    with contextlib.ExitStack() as open_transfers:
        for _ in range(4):
            open_transfers.enter_context(link.transfer())
        for block in range(10):
            for _ in range(4):
                link.cross(2500)
                if block == 9:
                    ends.append(clock.now - start)
    assert ends[-1] == pytest.approx(4 * 25_000 * 8 / 4e6)
    assert ends[0] == pytest.approx(37 / 40 * ends[-1]), "in turn, not one after the other"


def test_a_pause_between_transfers_saves_nothing_and_a_reader_that_stalls_little(clock):
    link = Link(1e6)
    with link.transfer():
        link.cross(100)
    clock.now += 0.2
    start = clock.now
    with link.transfer():
        link.cross(12_500)
        assert clock.now - start == pytest.approx(0.1)
        clock.now += 0.3
        start = clock.now
        link.cross(25_000)
        assert clock.now - start == pytest.approx(0.2 - CATCH_UP_SECONDS)


def test_the_server_sends_bodies_and_nothing_else_over_the_link(folder, monkeypatch):
    crossed = []
    link = Link(2e6)
    monkeypatch.setattr(link, "cross", crossed.append)
    (folder / "long.bin").write_bytes(bytes(30_000))
    with Server(folder, link=link) as server, server.running():
        ask(server, "/long.bin", Range="bytes=100-29999")
        ask(server, "/long.bin", "HEAD")
    assert sum(crossed) == 29_900 and max(crossed) == link.block


def test_latency_is_paid_by_the_connection_and_by_each_request(folder, monkeypatch):
    waits = []
    monkeypatch.setattr(
        server_module, "time", SimpleNamespace(sleep=waits.append, time=time.time, monotonic=time.monotonic)
    )
    with Server(folder, latency=0.05) as server, server.running():
        ask(server, "/bytes.bin")
        assert waits == [0.05, 0.05]
        ask(server, "/nothing")
        assert waits == [0.05] * 4


# -- on the wall clock -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("rate", "size"), RATES)
def test_a_served_file_takes_8S_over_B(folder, rate, size):
    def seconds(target: str) -> float:
        start = time.perf_counter()
        assert ask(server, target).status == 200
        return time.perf_counter() - start

    (folder / "long.bin").write_bytes(bytes(size))
    with Server(folder, link=Link(rate)) as server, server.running():
        seconds("/bytes.bin")
        took = statistics.median(seconds("/long.bin") for _ in range(5))
    expected = 8 * size / rate
    assert abs(took - expected) <= max(0.03 * expected, 0.01), f"{took:.4f} s, expected {expected:.4f}"
