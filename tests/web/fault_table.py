"""What the streaming client does when the link or the server fails, and whether all it shows is right.

Every row runs the client against a server on loopback behind a paced link. A picture counts as right if every array of
its scene equals that of an uninterrupted decode of the same prefix.
"""

from __future__ import annotations

import hashlib
import math
import random
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

from faulty import Fault, FaultyServer

from pd4dgs_codec.bench.latency import layer_rows, served
from pd4dgs_codec.errors import ChecksumMismatch, DeliveryError, Pd4Error, Truncated
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.npz import to_npz_dict
from pd4dgs_codec.scene import Scene
from pd4dgs_codec.web.client import SceneClient
from pd4dgs_codec.web.server import Link
from pd4dgs_codec.web.transfer import MAX_CHANGES, Transfer

RATE = 10e6
STALL_SECONDS = 1.0  #: after which the client takes silence for a cut in rows that have some; its default is 10
SLUMP = 0.1  #: share of the rate that a collapsed link still carries
SLUMP_SECONDS = 1.0
CUTS_PER_TRANSFER = 10
CRC_BYTES = 4  #: behind a chunk's payload
SAME_TAG: dict[str, str | None] = {"ETag": '"same"'}


def digest(scene: Scene) -> str:
    """SHA-256 over the name, type, shape and bytes of every array of a scene."""
    total = hashlib.sha256()
    for name, array in sorted(to_npz_dict(scene).items()):
        total.update(f"{name} {array.dtype} {array.shape};".encode() + array.tobytes())
    return total.hexdigest()


class File:
    """The file that the rows fetch, and another one that may take its place: the same scene coded worse."""

    def __init__(self, data: bytes):
        self.data, self.layers = data, layer_rows(data)
        self.ends = [end for _, end in self.layers]

    @cached_property
    def other(self) -> bytes:
        """Differs in every chunk and in length."""
        return encode(decode(self.data), effort=1, step_scale=1.25, verify=False)

    @cached_property
    def digests(self) -> dict[str, tuple[str, int]]:
        """(name, level) by digest, of both files."""
        contents = {"old": self.data, "new": self.other}
        levels = [*self.levels("old"), *self.levels("new")]
        return {digest(decode(contents[name], max_layer=layer)): (name, layer) for name, layer in levels}

    def levels(self, name: str = "old", size: float = math.inf) -> list[tuple[str, int]]:
        """(name, level) of the pictures that the first `size` bytes of the "old" or the "new" file give."""
        data = self.data if name == "old" else self.other
        return [(name, layer) for layer, end in layer_rows(data) if end <= size]

    def middle(self, index: int) -> int:
        """A byte in the middle of the layer at `index`, counted from the start of the file."""
        return ((self.ends[index - 1] if index else 0) + self.ends[index]) // 2

    def damaged(self, index: int) -> bytes:
        """The file with one bit of that layer's payload changed."""
        data = bytearray(self.data)
        data[self.ends[index] - CRC_BYTES - 1] ^= 1
        return bytes(data)


@dataclass(frozen=True)
class Scenario:
    """One row: what the server does, and what the client must show, as (file, level); `error` must end it then.

    faults: one per request. weather: timers that change the link while the transfer runs. content: what is served
    first, the file itself for None. heeds_if_range: False for a server that takes If-Range for granted.
    """

    name: str
    expected: list[tuple[str, int]]
    faults: list[Fault] = field(default_factory=list)
    content: bytes | None = None
    ranges: bool = True
    heeds_if_range: bool = True
    error: type[Pd4Error] | None = None
    weather: Callable[[Link], list[threading.Timer]] = lambda link: []


@dataclass(frozen=True)
class Row:
    """What became of a scenario. shown: (file, level, seconds since the request) of each scene that the client gave,
    file "?" for one that equals no level of either. sent: bytes of bodies. kept: whether it is what had to come."""

    name: str
    shown: list[tuple[str, int, float]]
    requests: int
    cuts: int
    changes: int
    sent: int
    seconds: float
    error: str
    kept: bool


def scenarios(file: File, rate: float = RATE) -> list[Scenario]:
    """The table's rows, in order."""
    last = len(file.ends) - 1
    middle = file.middle(min(1, last))  # of the first layer that improves a picture already shown
    every, new, before = file.levels(), file.levels("new"), file.levels("old", middle)
    at = 8 * file.middle(0) / rate

    def slump(link: Link) -> list[threading.Timer]:
        changes = ((at, rate * SLUMP), (at + SLUMP_SECONDS, rate))
        return [threading.Timer(when, setattr, (link, "rate", then)) for when, then in changes]

    def replace(server: FaultyServer) -> None:
        server.content = file.other

    def repair(server: FaultyServer) -> None:
        server.content = file.data

    def alternate(server: FaultyServer) -> None:
        server.content = file.other if server.content == file.data else file.data

    return [
        Scenario("nothing", every),
        Scenario(f"the link falls to {SLUMP:.0%} for {SLUMP_SECONDS:g} s within layer 0", every, weather=slump),
        Scenario("silence, the connection stays open", every, [Fault(middle, "stall")]),
        Scenario("the server closes the connection", every, [Fault(middle)]),
        Scenario("the connection is reset", every, [Fault(middle, "reset")]),
        Scenario("three resets and a silence", every, [*[Fault(middle // 4, "reset")] * 3, Fault(9, "stall")]),
        Scenario("503 twice", every, [Fault(status=503), Fault(status=503)]),
        Scenario("closed midway, no ranges", every, [Fault(middle)], ranges=False),
        Scenario("another file after a cut", [*before, *new], [Fault(middle, then=replace)]),
        Scenario("another file after a cut, no ranges", [*before, *new], [Fault(middle, then=replace)], ranges=False),
        Scenario(
            "another file after every cut",
            [level for i in range(MAX_CHANGES + 1) for level in file.levels(("old", "new")[i % 2], middle)],
            [Fault(middle, then=alternate)] * (MAX_CHANGES + 2),
            error=DeliveryError,
        ),
        Scenario(
            "a bit of the layer flipped on the way",
            every,
            [Fault(headers=SAME_TAG, then=repair), Fault(headers=SAME_TAG)],
            content=file.damaged(min(1, last)),
            heeds_if_range=False,
        ),
        Scenario("a bit of the layer flipped in the file", before, content=file.damaged(min(1, last)),
                 error=ChecksumMismatch),
        Scenario("a file that ends within the layer", before, content=file.data[:middle], error=Truncated),
        Scenario("404", [], [Fault(status=404)], error=DeliveryError),
    ]  # fmt: skip


def run(file: File, scenario: Scenario, rate: float = RATE) -> Row:
    """The row of one scenario."""
    link = Link(rate)
    content = file.data if scenario.content is None else scenario.content
    scenes: list[tuple[Scene, float]] = []
    error: Pd4Error | None = None
    timers = scenario.weather(link)
    silent = any(fault.how == "stall" for fault in scenario.faults)
    patience = {"stall": STALL_SECONDS} if silent else {}
    with FaultyServer(content, list(scenario.faults), ranges=scenario.ranges, link=link) as server:
        server.heeds_if_range = scenario.heeds_if_range
        for timer in timers:
            timer.start()
        start = time.monotonic()
        with SceneClient(server.url, **patience) as client:
            try:
                for scene in client.scenes():
                    scenes.append((scene, time.monotonic() - start))
            except Pd4Error as caught:
                error = caught
            seconds = time.monotonic() - start
        sent = server.sent
    for timer in timers:
        timer.cancel()
    shown = [(*file.digests.get(digest(scene), ("?", scene.level)), at) for scene, at in scenes]
    as_expected = [picture[:2] for picture in shown] == scenario.expected
    ended = error is None if scenario.error is None else isinstance(error, scenario.error)
    transfer = client.transfer
    return Row(
        name=scenario.name,
        shown=shown,
        requests=transfer.requests,
        cuts=transfer.cuts,
        changes=transfer.changes,
        sent=sent,
        seconds=seconds,
        error="" if error is None else str(error).replace(f"{server.url}: ", ""),
        kept=as_expected and ended,
    )


@dataclass(frozen=True)
class Cuts:
    """Random cuts and resumes. wrong: transfers whose pictures were not those of one without cuts."""

    cuts: int
    transfers: int
    wrong: int
    seconds: float


def random_cuts(file: File, cuts: int, seed: int = 4) -> Cuts:
    """At least `cuts` closed or reset connections at random bytes, ten per transfer."""
    rng, made, wrong, transfers, start = random.Random(seed), 0, 0, 0, time.monotonic()
    while made < cuts:
        piece = len(file.data) // (CUTS_PER_TRANSFER + 1)
        faults = [Fault(rng.randint(1, piece), rng.choice(("close", "reset"))) for _ in range(CUTS_PER_TRANSFER)]
        with FaultyServer(file.data, faults) as server, SceneClient(server.url) as client:
            shown = [file.digests.get(digest(scene)) for scene in client.scenes()]
        wrong += shown != file.levels()
        made += client.transfer.cuts
        transfers += 1
    return Cuts(made, transfers, wrong, time.monotonic() - start)


@dataclass(frozen=True)
class Crowd:
    """Clients at once over one link. seconds: until the last one has its last byte. errors: in words."""

    clients: int
    rate: float
    bytes: int
    expected: float
    seconds: float
    errors: list[str]


def crowd(data: bytes, clients: int = 64, rate: float = 200e6) -> Crowd:
    """Fetches the file by many clients at once; a byte that differs is an error too."""
    errors: list[str] = []
    with served(data, rate) as url:
        barrier = threading.Barrier(clients + 1)

        def client() -> None:
            transfer = Transfer(url)
            barrier.wait()
            try:
                while transfer.read():
                    pass
                if transfer.data != data or transfer.cuts:
                    errors.append(f"{transfer.cuts} cuts, {len(transfer.data):,} bytes, expected {len(data):,}")
            except Exception as error:
                errors.append(f"{type(error).__name__}: {error}")
            finally:
                transfer.close()

        threads = [threading.Thread(target=client) for _ in range(clients)]
        for thread in threads:
            thread.start()
        barrier.wait()
        start = time.perf_counter()
        for thread in threads:
            thread.join()
        seconds = time.perf_counter() - start
    return Crowd(clients, rate, len(data), 8 * clients * len(data) / rate, seconds, errors)
