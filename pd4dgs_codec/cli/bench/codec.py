"""`pd4dgs-bench codec`: the codec's error against bytes and seconds, beside other coders."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.bench.output import add_output, add_views, finish, listed, one_of, prepare
from pd4dgs_codec.cli.common import OK, Console, Parser, UsageError, count, positive_float, positive_int, use_threads
from pd4dgs_codec.cli.files import is_pd4, read_bytes
from pd4dgs_codec.cli.progress import progress_bar

if TYPE_CHECKING:
    from pd4dgs_codec.bench.codec import Deviation, Point, Sweep
    from pd4dgs_codec.bench.peers import Row
    from pd4dgs_codec.scene import SceneInfo
    from pd4dgs_codec.view.frames import Frame

DETAILS = """\
A checkpoint is packed at every combination of step scale, mode and effort. Each file's error is measured on its values,
and on pictures against those of the checkpoint; a file without its checkpoint has bytes and times alone. Times: warm,
the median and quartiles of the repeats in one process (none begun after 5 s); cold, at the step scale nearest to 1,
whole fresh processes, with the largest memory they held. Peers code the same symbols, the same anchors, and the splats
of one instant: LZMA, zstd and constriction are always there, Draco, SPZ and fourdgs with the extra "bench", and torchac
where it is installed.

examples:
  pd4dgs-bench codec model.pt --data recordings/kitchen --downscale 2 --plot codec.png > codec.md
  pd4dgs-bench codec model.pt --quick
  pd4dgs-bench codec scene.pd4 --json"""

#: What --quick runs, where no option says otherwise.
QUICK: dict[str, Any] = {"step_scales": (1.0, 2.0), "modes": ("ans", "lzma"), "efforts": (1,), "repeats": 1, "cold": 0}
#: Effort and pictures where no option says otherwise.
PEER_EFFORT, VIEWS, QUICK_VIEWS = 5, 6, 2


def parser() -> Parser:
    """The options of the report."""
    summary = "Measure what the codec's error costs in bytes and seconds, and what other coders make of the same data."
    p = Parser("bench codec", "model.pt|FILE.pd4", summary, DETAILS)
    p.add_argument(
        "input", metavar="FILE", help="checkpoint of pd4dgs-train, or a .pd4 file; - reads a .pd4 from stdin"
    )
    p.add_argument(
        "--step-scales",
        type=listed(positive_float),
        metavar="X,...",
        help="factors on every quantisation step (default: 0.5,1,2,4)",
    )
    p.add_argument(
        "--modes", type=listed(one_of(("ans", "lzma"))), metavar="M,...", help="entropy coders (default: ans,lzma)"
    )
    p.add_argument("--efforts", type=listed(_effort), metavar="N,...", help="1 fast to 9 small (default: 1,5,9)")
    p.add_argument("--repeats", type=positive_int, metavar="N", help="runs per warm time (default: 5)")
    p.add_argument("--cold", type=count, metavar="N", help="fresh processes per cold time; 0: none (default: 1)")
    p.add_argument("--no-peers", action="store_true", help="leave out the other coders")
    p.add_argument("--quick", action="store_true", help="few points, one run each, no fresh processes")
    add_views(p, f"{VIEWS}; with --quick {QUICK_VIEWS}")
    add_output(p)
    return p


def execute(args: argparse.Namespace, console: Console) -> int:
    """Runs the sweep, or measures the one file."""
    prepare(args, console)
    data = read_bytes(args.input)
    use_threads(args)
    from pd4dgs_codec.bench import codec, peers
    from pd4dgs_codec.bench.machine import describe, sentence

    machine = describe(peers.PACKAGES)
    what = codec.Sweep(**_options(args))
    masks = None
    if is_pd4(data):
        if args.plot is not None:
            raise UsageError("--plot: a file without its checkpoint has no error to plot; expected a checkpoint")
        points = [codec.file_point(data, what.repeats, what.cold)]
    else:
        points, masks, data = _swept(args, what)
    result: dict[str, Any] = {"input": args.input, "machine": machine}
    result |= {"points": codec.as_json(points), "masks": None if masks is None else vars(masks)}
    parts = [codec.points_table(points)]
    if masks is not None:
        parts.append(codec.values_table(points, masks))
    if not args.no_peers:
        console.message("other coders on the same data")
        rows, rate_bits = _beside(args, data, codec.usual(points).bytes, what.repeats)
        result |= {"peers": peers.as_json(rows), "peers_rate_bits": rate_bits}
        parts.append(peers.table(rows, rate_bits))
    text = "\n\n".join([*parts, sentence(machine)])
    finish(args, console, result, text, codec.panels(points), "RMSE of pictures")
    return OK


def _swept(args: argparse.Namespace, what: Sweep) -> tuple[list[Point], Deviation, bytes]:
    """(points of a checkpoint, what its mask codes lose, a file of its symbols, which no effort changes)."""
    from pd4dgs_codec.bench import codec
    from pd4dgs_codec.codec.encoder import encode
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene

    model, _ = checkpoint.load(args.input)
    scene = to_scene(model)
    masks = codec.mask_deviation([model.masks(i).detach().numpy() for i in scene.layers], scene.mask)
    pictures = _frames(args, scene.info)
    with progress_bar(len(what), "files", "codec") as step:
        points = codec.sweep(args.input, scene, pictures, what, step)
    return points, masks, encode(scene, effort=1, verify=False)


def _beside(args: argparse.Namespace, data: bytes, own_bytes: int, repeats: int) -> tuple[list[Row], float]:
    """(rows of all coders on the file's symbols, anchors and splats, the symbols' sum of R(a) in bits)."""
    from pd4dgs_codec.bench import peers
    from pd4dgs_codec.codec.decoder import decode_layers
    from pd4dgs_codec.view.levels import load_levels

    layers = decode_layers(data)[1]
    symbols, level = peers.symbols_of(layers), load_levels(data)[-1]
    pictures = _frames(args, level.model.info)
    rows = peers.coder_rows(symbols, repeats, PEER_EFFORT) + peers.position_rows(layers, repeats)
    rows += peers.splat_rows(level, pictures[len(pictures) // 2], own_bytes, repeats)
    return rows, symbols.rate_bits


def _frames(args: argparse.Namespace, info: SceneInfo) -> list[Frame]:
    from pd4dgs_codec.bench.views import frames

    return frames(info, args.data, args.views or (QUICK_VIEWS if args.quick else VIEWS), args.downscale, args.holdout)


def _effort(text: str) -> int:
    value = positive_int(text)
    if value > 9:
        raise argparse.ArgumentTypeError(f"found {text!r}, expected an integer from 1 to 9")
    return value


def _options(args: argparse.Namespace) -> dict[str, Any]:
    names = ("step_scales", "modes", "efforts", "repeats", "cold")
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return (QUICK if args.quick else {}) | given
