"""`pd4dgs-view`: a scene in the browser, from a local server that runs as long as the command."""

import argparse
import contextlib
from pathlib import Path
from urllib.parse import quote

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, Console, UsageError, command, say
from pd4dgs_codec.cli.serve import add_link, serving
from pd4dgs_codec.io import check_output, temporary_folder, write_bytes

DETAILS = """\
SCENE is a .pd4 file, the URL of one, or a checkpoint, which is encoded first.
The first line on stdout is the address of the page, printed when it is ready; the default browser opens it. Ctrl-C or
SIGTERM stops the server. The server of a URL must allow cross-origin requests, as pd4dgs-serve does.

-o writes one HTML file with the player and the scene instead, which browsers open without a server.

examples:
  pd4dgs-view scene.pd4
  pd4dgs-view model.pt --no-browser --port 8000
  pd4dgs-view scene.pd4 -o scene.html
  pd4dgs-view scene.pd4 --rate 2M --latency 50ms"""

SCENE = "scene.pd4"


def parser() -> options.Parser:
    p = options.Parser("view", "SCENE", "Show a scene in the browser.", DETAILS)
    p.add_argument("input", metavar="SCENE", help=".pd4 file, its URL, or .pt checkpoint; - reads stdin")
    what = "write one HTML file instead of starting a server"
    p.add_argument("-o", "--output", type=options.named, metavar="FILE", help=what)
    what = "port to listen on (default: any free port)"
    p.add_argument("--port", type=options.port, metavar="N", help=what)
    p.add_argument("--no-browser", action="store_true", help="do not open the browser")
    add_link(p)
    p.add_common()
    return p


def _view(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.web import PAGE, is_url
    from pd4dgs_codec.web.page import page

    options.conditional(args, not args.output, "has no effect with -o", port=0, rate=None, latency=0.0)
    if args.output:
        common.check_other_file(args.input, args.output)
        if Path(args.output).suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"found -o {args.output}, expected a name that ends in .html")
        check_output(args.output, args.overwrite)
        content = args.input if is_url(args.input) else _packed(args.input)
        write_bytes(args.output, page(content).encode(), args.overwrite)
        console.result({"output": args.output, "input": args.input}, args.output)
        return OK
    with temporary_folder() as folder:
        source, data = args.input, None if is_url(args.input) else _packed(args.input)
        (folder / PAGE).write_bytes(page(about=data).encode())
        if data is not None:
            (folder / SCENE).write_bytes(data)
            source = SCENE
        with serving(folder, args, console, port=args.port, private=True) as server:
            url = f"{server.url}{PAGE}?src={quote(source, safe='')}"
            console.result({"url": url, "input": args.input}, url, on_stdout=True)
            if not args.no_browser:
                import webbrowser

                with contextlib.suppress(webbrowser.Error, OSError):  # the address is printed in any case
                    webbrowser.open(url)
    return OK


main = command(parser, _view)


def _packed(source: str) -> bytes:
    """Reads a complete, valid `.pd4`, or encodes a checkpoint."""
    from pd4dgs_codec.format.decoder import decode

    data = common.read_bytes(source)
    if common.is_pd4(data):
        decode(data)  # report a damaged file here rather than in the page
        return data
    from pd4dgs_codec.format.encoder import encode
    from pd4dgs_codec.web.page import EFFORT

    scene = common.checkpoint_scene(source, data)
    say(f"{common.shown_name(source)}: encoding the checkpoint")
    return encode(scene, effort=EFFORT, omit="nothing")
