"""`python -m pd4dgs_codec VERB ...`: the same commands as the `pd4dgs-VERB` programs."""

import sys
from collections.abc import Sequence
from importlib import import_module

from pd4dgs_codec.cli.common import USAGE, open_streams, say, tell
from pd4dgs_codec.cli.options import version_line

VERBS = {
    "prepare": "estimate the camera poses of a video or its frames",
    "train": "train a layered scene from posed images",
    "encode": "encode a trained scene as a .pd4 file",
    "decode": "decode a .pd4 file or its first layers",
    "info": "show the header and layers of a .pd4 file",
    "render": "render a scene to images or a video",
    "eval": "measure quality, bytes and time of each level on a dataset",
    "import": "import a Scaffold-GS model",
    "export": "export a scene as Gaussians for other viewers",
    "bench": "measure error against run time, and latency",
    "package": "make a folder for web servers, with a page, DASH and HLS",
    "serve": "serve a folder over HTTP, with an optional rate limit",
    "view": "show a scene in the browser",
    "batch": "run a command on many scenes",
}

MODULES = {"import": "import_model"}  #: modules of verbs that are Python keywords


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one verb; returns its exit code."""
    open_streams()
    arguments = list(sys.argv[1:] if argv is None else argv)
    verb = arguments[0] if arguments else "--help"
    if verb in ("-h", "--help"):
        lines = ["usage: python -m pd4dgs_codec VERB ...   (VERB --help shows its options)", ""]
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
