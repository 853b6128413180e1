"""Progressive 4D Gaussian splatting: a layered codec, an open bitstream format and a trainer.

    data = encode(scene)                    # scene.Scene -> bytes of a .pd4 file
    scene = decode(data, max_layer=1)       # a prefix of its layers
    stream = open_stream()                  # stream.feed(bytes) -> a Scene per layer it adds to
    show(scene)                             # in a notebook: the player

Importing the package loads none of its modules; each name below imports its module at first use.
"""

TYPE_CHECKING = False  # no imports here: an interrupt of a command before `cli` is imported would print a traceback
if TYPE_CHECKING:
    from pd4dgs_codec.format.decoder import decode, open_stream
    from pd4dgs_codec.format.encoder import encode
    from pd4dgs_codec.format.info import FORMAT_VERSION
    from pd4dgs_codec.web.page import show

__version__ = "0.1.0"
__all__ = ["FORMAT_VERSION", "decode", "encode", "open_stream", "show"]

_HOMES = {
    "FORMAT_VERSION": "pd4dgs_codec.format.info",
    "decode": "pd4dgs_codec.format.decoder",
    "encode": "pd4dgs_codec.format.encoder",
    "open_stream": "pd4dgs_codec.format.decoder",
    "show": "pd4dgs_codec.web.page",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
