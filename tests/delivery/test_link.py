"""The paced link: times within max(3 %, 10 ms) of 8S/B, alone and shared."""

from __future__ import annotations

import statistics
import threading
import time

import pytest
from asking import ask

from pd4dgs_codec.delivery.link import Link
from pd4dgs_codec.delivery.server import Server


def _seconds(server: Server, target: str) -> float:
    start = time.perf_counter()
    assert ask(server, target).status == 200
    return time.perf_counter() - start


@pytest.mark.parametrize(("rate", "size"), [(2e6, 30_000), (10e6, 200_000), (50e6, 800_000)])
def test_a_file_takes_8S_over_B(folder, rate, size):
    (folder / "long.bin").write_bytes(bytes(size))
    with Server(folder, link=Link(rate)) as server, server.running():
        ask(server, "/bytes.bin")
        took = statistics.median(_seconds(server, "/long.bin") for _ in range(5))
    expected = 8 * size / rate
    assert abs(took - expected) <= max(0.03 * expected, 0.01), f"{took:.4f} s, expected {expected:.4f}"


def test_all_clients_share_one_link(folder):
    (folder / "long.bin").write_bytes(bytes(25_000))
    ends: list[float] = []
    with Server(folder, link=Link(4e6)) as server, server.running():
        start = time.perf_counter()

        def client():
            ask(server, "/long.bin")
            ends.append(time.perf_counter() - start)

        threads = [threading.Thread(target=client) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert max(ends) == pytest.approx(4 * 25_000 * 8 / 4e6, rel=0.15)
    assert min(ends) > 0.7 * max(ends)  # in turn, not one after the other


def test_a_rest_saves_nothing_up():
    link = Link(1e6)
    with link.transfer():
        link.cross(100)
    time.sleep(0.2)
    start = time.perf_counter()
    with link.transfer():
        link.cross(12_500)
    assert time.perf_counter() - start > 0.099


def test_a_reader_that_stalls_loses_what_the_link_did_not_carry():
    link = Link(1e6)
    with link.transfer():
        link.cross(100)
        time.sleep(0.3)
        start = time.perf_counter()
        link.cross(25_000)
        assert time.perf_counter() - start > 0.14  # 0.2 s less what it may catch up


def test_no_rate_is_no_limit():
    link, start = Link(), time.perf_counter()
    with link.transfer():
        link.cross(1 << 40)
    assert time.perf_counter() - start < 0.05


def test_latency_is_paid_by_the_connection_and_by_each_request(folder):
    with Server(folder, latency=0.05) as server, server.running():
        assert 0.1 <= _seconds(server, "/bytes.bin") < 0.3
