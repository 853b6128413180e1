"""`python -m pd4dgs_codec VERB ...`: the same commands as the `pd4dgs-VERB` programs."""

import sys
from collections.abc import Sequence
from importlib import import_module

from pd4dgs_codec.cli.common import USAGE, open_streams, say, tell
from pd4dgs_codec.cli.options import version_line

VERBS = {
    "prepare": "find the camera's poses in a video or its frames",
    "train": "train a layered scene from posed images",
    "encode": "pack a trained scene into a .pd4 file",
    "decode": "unpack a .pd4 file, or the first layers of one",
    "info": "show the header and the layers of a .pd4 file",
    "render": "render a file to pictures or a video",
    "eval": "measure each level of a file against a dataset",
    "import": "take over a model that another trainer made",
    "export": "write a scene as Gaussians that other viewers read",
    "bench": "measure what the codec, the renderer and the trainer promise",
    "package": "lay out a file for DASH, HLS and plain HTTP",
    "serve": "serve a folder over HTTP, at the rate of a slow link if wanted",
    "view": "show a scene in the browser",
    "batch": "run a command on every scene of a library",
}

MODULES = {"import": "import_model"}  #: modules of verbs that are Python keywords


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one verb; returns its exit code."""
    open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    verb = arguments[0] if arguments else "--help"
    if verb in ("-h", "--help"):
        lines = ["usage: python -m pd4dgs_codec VERB ...   (VERB --help explains each)", ""]
        lines += [f"  {name:<9}{summary}" for name, summary in VERBS.items()]
        if arguments:
            return tell("pd4dgs", "\n".join(lines))
        say("\n".join(lines))
        return USAGE
    if verb == "--version":
        return tell("pd4dgs", version_line("pd4dgs_codec"))
    if verb not in VERBS:
        say(f"pd4dgs: error: found {verb!r}, expected one of {', '.join(VERBS)}")
        return USAGE
    code: int = import_module(f"pd4dgs_codec.cli.{MODULES.get(verb, verb)}").main(arguments[1:])
    return code


if __name__ == "__main__":
    sys.exit(main())
