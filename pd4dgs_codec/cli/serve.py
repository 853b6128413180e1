"""`pd4dgs-serve`: a folder over HTTP, at the rate of a slow link if asked for."""

from __future__ import annotations

import argparse
import contextlib
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import OK, Console, command, say

if TYPE_CHECKING:
    from pd4dgs_codec.web.server import Server

DETAILS = """\
Answers GET and HEAD with ranges, If-Range, ETag and CORS. Files outside DIR and names that begin with a dot are not
served. A folder shows its index.html, else the names of its scenes. The first line on stdout is the URL, printed when
the server is ready. Ctrl-C or SIGTERM stops it.

--rate is the rate of one link shared by all clients, headers not counted. --latency is its round-trip time: one
per new connection and one per request.

For production, use any web server for static files; docs/player-and-delivery.md configures nginx and Caddy.

examples:
  pd4dgs-serve out/scene
  pd4dgs-serve out/scene --port 0 --rate 2M --latency 50ms"""


def parser() -> options.Parser:
    p = options.Parser("serve", "DIR", "Serve a folder over HTTP, with an optional rate limit.", DETAILS)
    p.add("input DIR", "folder to serve")
    p.add("--host H", "address to listen on (default: 127.0.0.1)", options.host, default="127.0.0.1")
    p.add("--port N", "port to listen on (default: 8000; 0: any free port)", options.port, default=8000)
    add_link(p.add)
    return p.add_common()


def add_link(add: options.Add) -> None:
    """Adds --rate and --latency of the simulated link."""
    add("--rate BPS", "link rate in bits per second, such as 2M (default: unlimited)", options.rate)
    add("--latency T", "round-trip time, such as 50ms (default: 0)", options.duration)


def _serve(args: argparse.Namespace, console: Console) -> int:
    with serving(args.input, args, console, host=args.host, port=args.port) as server:
        result = {"url": server.url, "folder": str(server.root), "rate": args.rate, "latency": server.latency}
        console.result(result, server.url, on_stdout=True)
    return OK


main = command(parser, _serve)


@contextlib.contextmanager
def serving(folder: str | Path, args: argparse.Namespace, console: Console, **where: Any) -> Iterator[Server]:
    """Serves a folder over the link of `add_link`; after the block, until Ctrl-C or SIGTERM. where: for Server."""
    from pd4dgs_codec.web.server import Link, Server

    log, latency, stop = say if console.verbose else None, args.latency or 0.0, threading.Event()
    with Server(folder, link=Link(args.rate), latency=latency, log=log, **where) as server:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: stop.set())
        with server.running():
            yield server
            stop.wait()
