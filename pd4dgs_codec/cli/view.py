"""`pd4dgs-view`: a scene in the browser, from a local server that lasts as long as the command."""

from __future__ import annotations

import argparse
import contextlib
import tempfile
from pathlib import Path
from urllib.parse import quote

from pd4dgs_codec.cli.common import OK, Console, Parser, command
from pd4dgs_codec.cli.files import checkpoint_scene, is_pd4, read_bytes
from pd4dgs_codec.cli.serve import set_by_signals
from pd4dgs_codec.cli.values import duration, port, rate
from pd4dgs_codec.io import check_output, write_bytes

DETAILS = """\
SCENE is a .pd4 file, a checkpoint, which is packed quickly first, or the URL of a .pd4. The first line on stdout is the
page's address, printed when it can be opened; the command ends on Ctrl-C or SIGTERM. A browser of this machine opens
the page by itself. A server of another site must allow pages of others to read it, as pd4dgs-serve does.

With -o the page is written instead, player and scene in one HTML file, which browsers open without a server.

examples:
  pd4dgs-view scene.pd4
  pd4dgs-view model.pt --no-browser --port 8000
  pd4dgs-view scene.pd4 -o scene.html
  pd4dgs-view scene.pd4 --rate 2M --latency 50ms"""

SCENE = "scene.pd4"
PACKING_EFFORT = 1


def parser() -> Parser:
    """The options of `pd4dgs-view`."""
    p = Parser("view", "SCENE", "Show a scene in the browser.", DETAILS)
    p.add_argument("input", metavar="SCENE", help=".pd4 file, .pt checkpoint or URL of a .pd4; - reads stdin")
    p.add_argument("-o", "--output", metavar="FILE", help="write one HTML file that shows the scene, and serve nothing")
    p.add_argument("--port", type=port, default=0, metavar="N", help="port to listen on (default: any free one)")
    p.add_argument("--no-browser", action="store_true", help="print the address and open nothing")
    p.add_argument("--rate", type=rate, metavar="BPS", help="show it as over a link of this rate, such as 2M")
    p.add_argument("--latency", type=duration, default=0.0, metavar="T", help="round trip, such as 50ms (default: 0)")
    p.add_common()
    return p


def _view(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.web.link import Link
    from pd4dgs_codec.web.page import PAGE, page
    from pd4dgs_codec.web.server import Server
    from pd4dgs_codec.web.urls import is_url

    if args.output:
        check_output(args.output, args.overwrite)
        content = args.input if is_url(args.input) else _packed(args.input, console)
        write_bytes(args.output, page(content).encode(), args.overwrite)
        console.result({"output": args.output, "input": args.input}, args.output, on_stdout=False)
        return OK
    with tempfile.TemporaryDirectory(prefix="pd4dgs-view-") as name:
        folder, source = Path(name), args.input
        (folder / PAGE).write_bytes(page().encode())
        if not is_url(source):
            (folder / SCENE).write_bytes(_packed(source, console))
            source = SCENE
        log = console.message if console.verbose else None
        with Server(folder, port=args.port, link=Link(args.rate), latency=args.latency, log=log) as server:
            stop = set_by_signals()
            with server.running():
                url = f"{server.url}{PAGE}?src={quote(source, safe='')}"
                console.result({"url": url, "input": args.input}, url, on_stdout=True)
                if not args.no_browser:
                    _open(url)
                stop.wait()
    return OK


main = command(parser, _view)


def _packed(source: str, console: Console) -> bytes:
    """The bytes of a `.pd4`, whole and valid; of a checkpoint those that packing it gives."""
    from pd4dgs_codec.format.decoder import decode

    data = read_bytes(source)
    if is_pd4(data):
        decode(data)  # a fault is better said here than in a page
        return data
    from pd4dgs_codec.format.encoder import encode

    scene = checkpoint_scene(source, data)
    console.message(f"{source}: packing the checkpoint")
    return encode(scene, effort=PACKING_EFFORT, omit="nothing")


def _open(url: str) -> None:
    """In the user's browser, if there is one; the address stands on the terminal anyway."""
    import webbrowser

    with contextlib.suppress(webbrowser.Error, OSError):
        webbrowser.open(url)
