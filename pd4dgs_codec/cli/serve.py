"""`pd4dgs-serve`: a folder over HTTP, at the rate of a slow link if asked for."""

from __future__ import annotations

import argparse
import signal
import threading

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import OK, Console, command

DETAILS = """\
Answers GET and HEAD with ranges, If-Range, ETag and CORS. Files outside DIR and names that begin with a dot are not
served. The first line on stdout is the URL, printed when the server listens. Ctrl-C or SIGTERM ends it.

--rate is the rate of one link that all clients share; headers are not counted. --latency is its round-trip time: a new
connection takes one round trip, each request another.

In production any server of static files will do. nginx:
  server {
    listen 80;
    root /srv/scenes;
    include mime.types;
    types { application/octet-stream pd4; application/dash+xml mpd; }
    gzip off;
    set $kept no-cache;
    if ($uri ~ "-[0-9a-f]{16}[.]") { set $kept "public, max-age=31536000, immutable"; }
    location / {
      add_header Cache-Control $kept;
      add_header Access-Control-Allow-Origin * always;
      add_header Access-Control-Expose-Headers "Accept-Ranges, Content-Length, Content-Range, ETag" always;
      if ($request_method = OPTIONS) {
        add_header Access-Control-Allow-Origin *;
        add_header Access-Control-Allow-Headers "Range, If-Range";
        return 204;
      }
    }
  }
Caddy:
  :80
  root * /srv/scenes
  header Access-Control-Allow-Origin *
  header Cache-Control no-cache
  @kept path_regexp -[0-9a-f]{16}[.]
  header @kept Cache-Control "public, max-age=31536000, immutable"
  header Access-Control-Allow-Headers "Range, If-Range"
  header Access-Control-Expose-Headers "Accept-Ranges, Content-Length, Content-Range, ETag"
  @preflight method OPTIONS
  respond @preflight 204
  @pd4 path *.pd4
  header @pd4 Content-Type application/octet-stream
  @mpd path *.mpd
  header @mpd Content-Type application/dash+xml
  file_server

examples:
  pd4dgs-serve out/scene
  pd4dgs-serve out/scene --port 0 --rate 2M --latency 50ms"""


def parser() -> options.Parser:
    """The options of `pd4dgs-serve`."""
    p = options.Parser("serve", "DIR", "Serve a folder over HTTP, at the rate of a slow link if asked for.", DETAILS)
    p.add_argument("input", metavar="DIR", help="folder to serve")
    p.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen on (default: 127.0.0.1)")
    p.add_argument("--port", type=options.port, default=8000, metavar="N", help="port; 0: any free one (default: 8000)")
    add_link(p)
    p.add_common()
    return p


def add_link(p: options.Parser) -> None:
    """--rate and --latency of the link."""
    what = "rate of the link in bits per second, such as 2M (default: unlimited)"
    p.add_argument("--rate", type=options.rate, metavar="BPS", help=what)
    what = "round-trip time of the link, such as 50ms (default: 0)"
    p.add_argument("--latency", type=options.duration, default=0.0, metavar="T", help=what)


def _serve(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.web.server import Link, Server

    log = console.message if console.verbose else None
    with Server(args.input, args.host, args.port, link=Link(args.rate), latency=args.latency, log=log) as server:
        stop = set_by_signals()
        with server.running():
            result = {"url": server.url, "folder": str(server.root), "rate": args.rate, "latency": args.latency}
            console.result(result, server.url, on_stdout=True)
            stop.wait()
    return OK


main = command(parser, _serve)


def set_by_signals() -> threading.Event:
    """An event that Ctrl-C and SIGTERM set from now on."""
    stop = threading.Event()
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: stop.set())
    return stop
