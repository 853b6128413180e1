"""`pd4dgs-import`: another trainer's checkpoint as one of ours."""

from __future__ import annotations

import argparse
from pathlib import Path

from pd4dgs_codec.cli import values
from pd4dgs_codec.cli.common import OK, Console, Parser, UsageError, command
from pd4dgs_codec.cli.files import STDIO, check_output, write_checkpoint

DETAILS = """\
FOLDER is a checkpoint of Scaffold-GS: the run's folder, or its point_cloud/iteration_N with point_cloud.ply and either
opacity_mlp.pt, cov_mlp.pt and color_mlp.pt or checkpoints.pth. It becomes layer 0, a still scene, exactly; encoding it
rounds as always. What cannot be taken over (distances as inputs, a bank of features) is refused by name. Nothing that
the files hold is run.

examples:
  pd4dgs-import output/garden -o garden.pt
  pd4dgs-import output/garden/point_cloud/iteration_30000 -o garden.pt --appearance 0
  pd4dgs-encode garden.pt -o garden.pd4"""


def parser() -> Parser:
    """The options of `pd4dgs-import`."""
    p = Parser("import", "FOLDER -o model.pt", "Take over a model that Scaffold-GS trained.", DETAILS)
    p.add_argument("input", metavar="FOLDER", help="the checkpoint")
    p.add_argument("-o", "--output", required=True, metavar="model.pt", help="checkpoint to write")
    what = "where colours depend on the picture: take the appearance of picture I"
    p.add_argument("--appearance", type=values.count, metavar="I", help=what)
    what = "anchors are multiples of V scene units (default: what cfg_args says, else found)"
    p.add_argument("--voxel-size", type=values.positive_float, metavar="V", help=what)
    p.add_argument("--iteration", type=values.count, metavar="N", help="of several iterations (default: the last)")
    p.add_common()
    return p


def _import(args: argparse.Namespace, console: Console) -> int:
    if args.output == STDIO:
        raise UsageError("found -o -, expected the name of a checkpoint to write")
    check_output(args.output, args.overwrite)
    from pd4dgs_codec.interchange.scaffold_gs import Choices, read_scaffold_gs

    scene = read_scaffold_gs(Path(args.input), Choices(args.appearance, args.voxel_size, args.iteration))
    write_checkpoint(args.output, scene, args.overwrite)
    result = {
        "input": args.input,
        "output": args.output,
        "kind": "Scaffold-GS",
        "anchors": len(scene.anchor_q),
        "voxel_size": scene.info.voxel_size,
        "camera": scene.info.camera is not None,
    }
    text = f"{args.output}: {result['anchors']:,} anchors of Scaffold-GS on a grid of {scene.info.voxel_size:g}"
    console.result(result, text, on_stdout=False)
    return OK


main = command(parser, _import)
