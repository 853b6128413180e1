"""`pd4dgs-view`: a scene in the browser, from a local server that runs as long as the command."""

import argparse
import contextlib
import os
import shutil
from pathlib import Path

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, Console, UsageError, command, say
from pd4dgs_codec.cli.serve import add_link, serving
from pd4dgs_codec.errors import DataError, DecodeError
from pd4dgs_codec.io import check_output, temporary_folder, write_bytes

DETAILS = """\
SCENE is a .pd4 file, the URL of one, a folder of segments, a folder of .pd4 files, from which the page lets you choose,
or a checkpoint, which is encoded first. --sample shows the scene that comes with the package.
The first line on stdout is the address of the page, printed when it is ready; the default browser opens it. Ctrl-C or
SIGTERM stops the server. The server of a URL must allow cross-origin requests, as pd4dgs-serve does.

-o writes one HTML file with the player and the scene instead, which browsers open without a server.

examples:
  pd4dgs-view --sample
  pd4dgs-view scene.pd4
  pd4dgs-view out/scenes
  pd4dgs-view model.pt --no-browser --port 8000
  pd4dgs-view scene.pd4 -o scene.html
  pd4dgs-view scene.pd4 --rate 2M --latency 50ms"""

SCENE = "scene.pd4"


def parser() -> options.Parser:
    p = options.Parser("view", "SCENE", "Show a scene in the browser.", DETAILS)
    options.add_file(p.add, "SCENE", ".pd4 file, its URL, a folder of .pd4 files, or .pt checkpoint; - reads stdin")
    p.add("-o, --output FILE", "write one HTML file instead of starting a server", options.named)
    p.add("--port N", "port to listen on (default: any free port)", options.port)
    p.add("--no-browser", "do not open the browser")
    add_link(p.add)
    return p.add_common()


def _view(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.segments import INDEX, is_folder, read_index
    from pd4dgs_codec.web import PAGE, is_url
    from pd4dgs_codec.web.package import player_of
    from pd4dgs_codec.web.page import page

    options.choose_file(args, "SCENE")
    options.conditional(args, not args.output, "has no effect with -o", port=0, rate=None, latency=0.0)
    if args.output:
        common.check_other_file(args.input, args.output)
        if Path(args.output).suffix.lower() not in (".html", ".htm"):
            raise UsageError(f"found -o {args.output}, expected a name that ends in .html")
        check_output(args.output, args.overwrite)
        if is_folder(args.input):
            raise UsageError(f"{args.input} is a folder of segments, which one page cannot hold: see pd4dgs-package")
        content = args.input if is_url(args.input) else _packed(args.input)
        write_bytes(args.output, page(content).encode(), args.overwrite)
        console.result({"output": args.output, "input": args.input}, args.output)
        return OK
    with temporary_folder() as folder:
        several = os.path.isdir(args.input) or is_url(args.input) or is_folder(args.input)
        data = None if several else _packed(args.input)
        (folder / PAGE).write_bytes(page(about=data).encode())
        if data is not None:
            (folder / SCENE).write_bytes(data)
            shown = player_of(SCENE)
        elif is_url(args.input):
            shown = player_of(args.input)
        elif is_folder(args.input):
            place, index = read_index(args.input)
            for name in (INDEX, *(file.file for file in index.files)):
                with contextlib.suppress(FileNotFoundError):  # the player says what is missing
                    shutil.copyfile(place / name, folder / name)
            shown = player_of(INDEX)
        else:
            shown = _copied(args.input, folder)
        with serving(folder, args, console, port=args.port, private=True) as server:
            url = f"{server.url}{shown}"
            console.result({"url": url, "input": args.input}, url, on_stdout=True)
            if not args.no_browser:
                import webbrowser

                with contextlib.suppress(webbrowser.Error, OSError):  # the address is printed in any case
                    webbrowser.open(url)
    return OK


main = command(parser, _view)


def _copied(source: str, folder: Path) -> str:
    """Copies all `.pd4` files of a folder to another one, beside a page that lists them; returns the page's name."""
    from pd4dgs_codec.web.package import CHOICE, choice_page

    names = sorted(path.name for path in Path(source).glob("*.pd4") if path.is_file() and path.name[0] != ".")
    if not names:
        raise DataError(f"{source}: found no .pd4 file in this folder, expected one or more")
    sizes = dict[str, int]()
    for name in names:
        try:
            sizes[name] = (folder / name).write_bytes(_packed(str(Path(source) / name)))
        except DecodeError as error:
            raise DataError(f"{Path(source) / name}: {error}") from None
    (folder / CHOICE).write_bytes(choice_page(sizes))
    return CHOICE


def _packed(source: str) -> bytes:
    """Reads a complete, valid `.pd4`, or encodes a checkpoint."""
    from pd4dgs_codec.format.decoder import decode

    data = common.read_bytes(source)
    if common.is_pd4(data):
        decode(data)  # report a damaged file here rather than in the page
        return data
    from pd4dgs_codec.format.encoder import encode
    from pd4dgs_codec.web.page import EFFORT

    scene, *_ = common.checkpoint_scene(source, data)
    say(f"{common.shown_name(source)}: encoding the checkpoint")
    return encode(scene, effort=EFFORT, omit="nothing")
