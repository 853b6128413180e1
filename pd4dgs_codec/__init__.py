"""Progressive 4D Gaussian splatting: a layered codec, an open bitstream format and a trainer.

    scene = decode("scene.pd4")             # or its bytes; max_layer=1: a prefix of its layers
    scene.gaussians(0.5)                    # numpy arrays of the Gaussians at the middle of the time
    render(scene, scene.info.camera, 0.5)   # a picture, float32 [H, W, 3]
    data = encode(scene)                    # a Scene or SplatScene -> bytes of a .pd4 file
    stream = open_stream()                  # stream.feed(bytes) -> a scene per layer it adds to
    decode_tensors("scene.pd4")             # arrays by layer, form and id, whatever the kind of the scene
    decode(segment, base=read_base(file))   # a file that adds to layer 0 of another one
    show(scene)                             # in a notebook: the player
    sample()                                # the path of a scene that comes with the package

Importing the package loads none of its modules; each name below imports its module at first use.
"""

TYPE_CHECKING = False  # no imports here: an interrupt of a command before `cli` is imported would print a traceback
if TYPE_CHECKING:
    from pathlib import Path

    from pd4dgs_codec.draw import render
    from pd4dgs_codec.format.decoder import decode, open_stream
    from pd4dgs_codec.format.encoder import encode
    from pd4dgs_codec.format.info import FORMAT_VERSION
    from pd4dgs_codec.format.reader import decode_tensors, read_base
    from pd4dgs_codec.kinds.splats import SplatScene
    from pd4dgs_codec.scene import Camera, Scene
    from pd4dgs_codec.web.page import show

__version__ = "0.1.0"
__all__ = [
    "Camera",
    "FORMAT_VERSION",
    "Scene",
    "SplatScene",
    "decode",
    "decode_tensors",
    "encode",
    "open_stream",
    "read_base",
    "render",
    "sample",
    "show",
]

_HOMES = {
    "Camera": "pd4dgs_codec.scene",
    "FORMAT_VERSION": "pd4dgs_codec.format.info",
    "Scene": "pd4dgs_codec.scene",
    "SplatScene": "pd4dgs_codec.kinds.splats",
    "decode": "pd4dgs_codec.format.decoder",
    "decode_tensors": "pd4dgs_codec.format.reader",
    "encode": "pd4dgs_codec.format.encoder",
    "open_stream": "pd4dgs_codec.format.decoder",
    "read_base": "pd4dgs_codec.format.reader",
    "render": "pd4dgs_codec.draw",
    "show": "pd4dgs_codec.web.page",
}


def sample() -> "Path":
    """Returns the path of the `.pd4` file that comes with the package: a figure that dances."""
    from pathlib import Path

    return Path(__file__).parent / "samples" / "dancer.pd4"


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOMES])
