"""The client under faults of server and link: its scenes equal those of an uninterrupted download."""

from __future__ import annotations

import random
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import pytest
from faulty import Fault, FaultyServer
from strategies import assert_same_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import ChecksumMismatch, DeliveryError, Pd4Error, Truncated
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web.client import SceneClient
from pd4dgs_codec.web.server import Link, Server
from pd4dgs_codec.web.transfer import MAX_CHANGES, Transfer, slice_ends

RATE = 10e6


class File:
    """A file of three layers, and another one, the same scene with coarser steps, that may replace it."""

    def __init__(self, data: bytes):
        self.data = data
        self.other = encode(decode(data), effort=1, step_scale=1.25, verify=False)
        self.ends = [end for _, end in slice_ends(data)]
        self.middle = (self.ends[0] + self.ends[1]) // 2

    def scenes(self, of: bytes | None = None, size: float = float("inf")) -> list[Scene]:
        """Scenes of the prefixes that end within `size` bytes."""
        data = self.data if of is None else of
        return [decode(data, max_layer=layer) for layer, end in slice_ends(data) if end <= size]

    @property
    def damaged(self) -> bytes:
        """One bit of layer 1 changed."""
        data = bytearray(self.data)
        data[self.ends[1] - 5] ^= 1
        return bytes(data)


@pytest.fixture(scope="module")
def file(scene_bytes) -> File:
    return File(scene_bytes)


@dataclass
class Case:
    """Faults, one per request, and what the client must yield; `error` must end it then. heeds_if_range: False for a
    server that ignores the condition. weather: timers that change the link."""

    faults: list[Fault] = field(default_factory=list)
    shown: Callable[[File], list[Scene]] = File.scenes
    content: Callable[[File], bytes] = lambda file: file.data
    ranges: bool = True
    heeds_if_range: bool = True
    error: type[Pd4Error] | None = None
    changes: int = 0
    weather: Callable[[Link], list[threading.Timer]] = lambda link: []


def slump(link: Link) -> list[threading.Timer]:
    """The link falls to a tenth for a fifth of a second."""
    return [threading.Timer(when, setattr, (link, "rate", rate)) for when, rate in ((0.002, RATE / 10), (0.2, RATE))]


def becomes(content: Callable[[File, bytes], bytes], file: File) -> Callable[[FaultyServer], None]:
    return lambda server: setattr(server, "content", content(file, server.content))


def cases(file: File) -> dict[str, Case]:
    middle, same = file.middle, {"ETag": '"same"'}
    replaced = becomes(lambda file, _: file.other, file)
    alternated = becomes(lambda file, now: file.other if now == file.data else file.data, file)
    repaired = becomes(lambda file, _: file.data, file)
    before: Callable[[File], list[Scene]] = lambda file: file.scenes(size=middle)  # noqa: E731
    both: Callable[[File], list[Scene]] = lambda file: before(file) + file.scenes(file.other)  # noqa: E731

    def each_in_turn(file: File) -> list[Scene]:
        contents = [(file.data, file.other)[i % 2] for i in range(MAX_CHANGES + 1)]
        return [scene for content in contents for scene in file.scenes(content, middle)]

    return {
        "nothing": Case(),
        "slow link": Case(weather=slump),
        "silence": Case([Fault(middle, "stall")]),
        "closed": Case([Fault(middle)]),
        "reset": Case([Fault(middle, "reset")]),
        "three resets and a silence": Case([*[Fault(middle // 4, "reset")] * 3, Fault(9, "stall")]),
        "503 twice": Case([Fault(status=503), Fault(status=503)]),
        "closed, no ranges": Case([Fault(middle)], ranges=False),
        "another file": Case([Fault(middle, then=replaced)], both, changes=1),
        "another file, no ranges": Case([Fault(middle, then=replaced)], both, ranges=False, changes=1),
        "another file every time": Case(
            [Fault(middle, then=alternated)] * (MAX_CHANGES + 2),
            each_in_turn,
            error=DeliveryError,
            changes=MAX_CHANGES + 1,
        ),
        "a bit flipped on the way": Case(
            [Fault(headers=same, then=repaired), Fault(headers=same)],
            content=lambda file: file.damaged,
            heeds_if_range=False,
        ),
        "a bit flipped in the file": Case(shown=before, content=lambda file: file.damaged, error=ChecksumMismatch),
        "a short file": Case(shown=before, content=lambda file: file.data[:middle], error=Truncated),
        "404": Case([Fault(status=404)], lambda file: [], error=DeliveryError),
    }


@pytest.mark.parametrize(
    "name",
    [
        *("nothing", "slow link", "silence", "closed", "reset", "three resets and a silence", "503 twice"),
        *("closed, no ranges", "another file", "another file, no ranges", "another file every time"),
        *("a bit flipped on the way", "a bit flipped in the file", "a short file", "404"),
    ],
)
def test_the_client_yields_the_scenes_of_the_file(file, name):
    case, link = cases(file)[name], Link(RATE)
    timers = case.weather(link)
    error: Pd4Error | None = None
    shown: list[Scene] = []
    with FaultyServer(case.content(file), case.faults, ranges=case.ranges, link=link) as server:
        server.heeds_if_range = case.heeds_if_range
        for timer in timers:
            timer.start()
        with SceneClient(server.url, stall=0.3) as client:
            try:
                shown.extend(client.scenes())
            except Pd4Error as caught:
                error = caught
    for timer in timers:
        timer.cancel()
    assert type(error) is (case.error or type(None)), error
    expected = case.shown(file)
    assert [scene.layers for scene in shown] == [scene.layers for scene in expected]
    for got, scene in zip(shown, expected, strict=True):
        assert_same_scene(got, scene)
    assert client.transfer.changes == case.changes
    if name == "nothing":
        assert server.sent == len(file.data)


@pytest.mark.parametrize("cuts", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_cuts_give_the_same_scenes(file, cuts):
    rng, made, expected = random.Random(4), 0, file.scenes()
    while made < cuts:
        faults = [Fault(rng.randint(1, len(file.data) // 11), rng.choice(("close", "reset"))) for _ in range(10)]
        with FaultyServer(file.data, faults) as server, SceneClient(server.url) as client:
            shown = list(client.scenes())
        assert len(shown) == 3
        for got, scene in zip(shown, expected, strict=True):
            assert_same_scene(got, scene)
        made += client.transfer.cuts


@pytest.mark.parametrize("clients", [4, pytest.param(64, marks=pytest.mark.slow)])
def test_many_clients_at_once_get_every_byte(folder, scene_bytes, clients):
    results: list[tuple[bytes, int]] = []
    with Server(folder, link=Link(200e6)) as server, server.running():

        def fetch() -> None:
            transfer = Transfer(server.url_of("scene.pd4"))
            while transfer.read():
                pass
            results.append((bytes(transfer.data), transfer.cuts))
            transfer.close()

        threads = [threading.Thread(target=fetch) for _ in range(clients)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    assert results == [(scene_bytes, 0)] * clients
