"""`pd4dgs-import`: another program's model -> a `.pd4` file, or a checkpoint where training is meant."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, Console, UsageError, number, progress_bar, say, table

if TYPE_CHECKING:
    from pd4dgs_codec.interchange.imported import Imported

DETAILS = """\
SOURCE is found by its content:
  a PLY, compressed PLY, SPZ, SOG or .splat file, or a checkpoint of gsplat: a static scene
  a folder of PLY, SPZ, SOG or .splat files, one per frame; whether rows keep their Gaussians is detected, and
    Gaussians without a counterpart in the neighbouring frames get a window in time
  a run of 4DGaussians, Deformable-3DGS or SC-GS, or one of its point_cloud/iteration_N
  a run of 4DGS or one of its chkpnt*.pth, whose duration --seconds sets if it is detected wrongly
  a PLY file of SpacetimeGaussians (lite), a .splatv or .4dgs file
  module:function, a Python function from time 0..1 to Gaussians
Its Gaussians and their motion are packed as they are, without training. pd4dgs-train teacher:SOURCE learns a neural
scene from its renderings instead: fewer bytes at low quality, in minutes. Code in files is never executed.

--psnr D asks for D dB against the source's renderings; --quality Q means 32 + Q / 5 dB. Quality is measured from the
cameras of a cameras.json beside the source, else from cameras on a dome around it.

--segments 2s makes a folder: a file for every two seconds or so, and one for the Gaussians that are static in all of
them. Memory does not grow with the length. After an interruption, the same command resumes.

-o model.pt imports a run of Scaffold-GS as a checkpoint: layer 0 without loss, which pd4dgs-encode packs.

examples:
  pd4dgs-import capture.ply -o scene.pd4
  pd4dgs-import frames/ -o scene.pd4 --fps 30 --target-size 400k --slices 50k
  pd4dgs-import output/lego -o lego.pd4 --psnr 42
  pd4dgs-import hour/ -o hour.pd4s --segments 2s --fps 30
  pd4dgs-import output/garden -o garden.pt --appearance 0"""

#: dB of quality 0, and of each further point.
LOWEST_DB, POINT_DB = 32.0, 0.2
QUALITY = 50.0
#: Options of .pd4 files, and of checkpoints.
PACKING = (
    "psnr", "quality", "target_size", "slices", "segments", "fps", "seconds", "background", "up", "title", "source",
    "licence",
)  # fmt: skip
SCAFFOLD = ("appearance", "voxel_size")


def parser() -> options.Parser:
    p = options.Parser("import", "SOURCE -o FILE.pd4", "Pack a model of another program.", DETAILS)
    p.add("input SOURCE", "file, folder or module:function, see below")
    p.add("-o, --output FILE.pd4", "file to write; a checkpoint if it ends in .pt", options.named, required=True)
    goal = p.exclusive()
    what = f"0 (small files) to 100 (default: {QUALITY:g})"
    goal("--quality Q", what, options.checked(float, lambda q: 0 <= q <= 100, "0 to 100"))
    goal("--target-size SIZE", "most bytes of the file, such as 400k", options.size)
    db = options.checked(float, lambda d: 10 <= d <= 80, "10 to 80")
    goal("--psnr D", "dB against the source's renderings", db)
    p.add("--slices SIZE", "cut layers into slices, the first of at most SIZE bytes", options.size)
    p.add("--segments T", "write a folder of segments of about this length, such as 2s", options.duration)
    rate = p.exclusive()
    rate("--fps F", "frames per second of a folder (default: 30)", options.fps)
    rate("--seconds S", "duration, from the first instant to the last", options.positive_float)
    options.add_background(p.add, "that of the run, else black")
    p.add("--up X,Y,Z", "up direction (default: of the cameras, else 0,-1,0)", _direction)
    options.add_metadata(p, "shown by pd4dgs-info")
    scaffold = p.group("Scaffold-GS, with -o model.pt")
    scaffold("--appearance I", "appearance embedding to use, if colours depend on one", options.count)
    what = "voxel size of the anchor grid in scene units (default: from cfg_args or the anchors)"
    scaffold("--voxel-size V", what, options.positive_float)
    return p.add_common()


def _direction(text: str) -> tuple[float, ...]:

    def numbers(text: str) -> tuple[float, ...]:
        return tuple(map(float, text.split(",")))

    return options.checked(numbers, lambda v: len(v) == 3 and 0 < math.hypot(*v) < math.inf, "X,Y,Z")(text)


def _import(args: argparse.Namespace, console: Console) -> int:
    to_checkpoint = args.output.lower().endswith(".pt")
    for name in PACKING if to_checkpoint else SCAFFOLD:
        if getattr(args, name) is not None:
            needed = "a .pd4 file" if to_checkpoint else "-o model.pt"
            raise UsageError(f"--{name.replace('_', '-')} needs {needed}")
    common.check_other_file(args.input, args.output)
    if args.segments is not None:
        options.conditional(args, False, "makes one file, without --segments", target_size=None, slices=None)
        return _segments(args, console)
    common.check_output(args.output, args.overwrite)
    return _checkpoint(args, console) if to_checkpoint else _pack(args, console)


def _checkpoint(args: argparse.Namespace, console: Console) -> int:
    """Imports a run of Scaffold-GS."""
    from pathlib import Path

    from pd4dgs_codec.interchange.scaffold_gs import read_scaffold_gs

    scene = read_scaffold_gs(Path(args.input), args.appearance, args.voxel_size)
    common.write_checkpoint(args.output, scene, args.overwrite)
    result = {
        "input": args.input,
        "output": args.output,
        "kind": "Scaffold-GS",
        "anchors": len(scene.anchor_q),
        "voxel_size": scene.info.voxel_size,
        "camera": scene.info.camera is not None,
    }
    text = f"{args.output}: {result['anchors']:,} Scaffold-GS anchors on a grid of {scene.info.voxel_size:g} units"
    console.result(result, text)
    return OK


def _pack(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.interchange.imported import import_model

    made = import_model(args.input, most_bytes=args.target_size, slices=args.slices, **_asked(args))
    common.write_bytes(args.output, made.data, args.overwrite)
    result = {"input": args.input, "output": args.output, **made.json()}
    console.result(result, _text(args.output, made))
    return OK


def _segments(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.interchange.segmented import import_segments

    made = import_segments(args.input, args.output, length=args.segments, overwrite=args.overwrite, **_asked(args))
    sizes = [sum(file.bytes for file in files) for files in (made.index.bases, made.index.segments)]
    seconds = made.index.time_range[1] - made.index.time_range[0]
    result = {
        "input": args.input,
        "output": args.output,
        "segments": len(made.index.segments),
        "kept": made.kept,
        "bytes": sum(sizes),
        "base_bytes": sizes[0],
        "seconds": seconds,
        "psnr": made.psnr,
        "gaussians": made.gaussians,
        "still": made.still,
    }
    text = f"{args.output}: {len(made.index.segments)} segments, {made.kept} of them kept, {number(made.psnr)} dB; "
    text += f"{sizes[0]:,} bytes of static Gaussians, {sizes[1] / seconds:,.0f} a second of the others"
    console.result(result, text)
    return OK


def _asked(args: argparse.Namespace) -> dict[str, Any]:
    """What one file and segments are made with."""
    from pd4dgs_codec.format.metadata import Metadata

    return {
        "psnr": args.psnr or LOWEST_DB + POINT_DB * (QUALITY if args.quality is None else args.quality),
        "fps": args.fps,
        "seconds": args.seconds,
        "background": args.background,
        "up": args.up,
        "metadata": Metadata(**options.given(args, "title", "source", "licence")),
        "tell": lambda text: None if args.json else say(text),
        "progress": lambda what, total: progress_bar(total, "steps", what),
    }


def _text(name: str, made: Imported) -> str:
    rows = []
    for layer in made.report.layers:
        parts = [f"{part.name} {part.payload_bits / 8:,.0f}" for part in layer.streams]
        rows.append((layer.layer, number(layer.bytes, 0), number(made.psnr.get(layer.layer)), ", ".join(parts)))
    found: list[Any] = [table(("level", "bytes", "dB", "bytes of its parts"), rows)]
    if made.left_out:
        found.append(f"left out: {made.left_out:,} Gaussians that no view needs")
    size = f"{len(made.data):,} bytes, {len(made.data) / made.gaussians:.2f} a Gaussian"
    found.append(f"{name}: {size}; dB against the source from {made.views} other cameras and instants")
    return "\n".join(found)


main = common.command(parser, _import)
