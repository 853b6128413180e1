"""`pd4dgs-import`: another trainer's checkpoint -> a checkpoint of ours."""

import argparse
from pathlib import Path

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import OK, Console, check_output, command, write_checkpoint

DETAILS = """\
FOLDER is a Scaffold-GS checkpoint: its point_cloud/iteration_N, with point_cloud.ply and either opacity_mlp.pt,
cov_mlp.pt and color_mlp.pt or checkpoints.pth, or a run, of which the last iteration is read.
The model becomes layer 0, a static scene, without loss; encoding quantises it as usual.
Models with features that layer 0 does not support (distance inputs, a feature bank) are refused.
Runs of 4DGaussians and Deformable-3DGS cannot be imported; pd4dgs-train teacher:FOLDER trains on their renderings.
Code in the files is never executed.

examples:
  pd4dgs-import output/garden -o garden.pt
  pd4dgs-import output/garden/point_cloud/iteration_30000 -o garden.pt --appearance 0
  pd4dgs-encode garden.pt -o garden.pd4"""


def parser() -> options.Parser:
    p = options.Parser("import", "FOLDER -o model.pt", "Import a Scaffold-GS model.", DETAILS)
    p.add_argument("input", metavar="FOLDER", help="Scaffold-GS checkpoint")
    p.add_argument("-o", "--output", required=True, type=options.named, metavar="model.pt", help="checkpoint to write")
    what = "appearance embedding to use, if colours depend on one"
    p.add_argument("--appearance", type=options.count, metavar="I", help=what)
    what = "voxel size of the anchor grid in scene units (default: from cfg_args or the anchors)"
    p.add_argument("--voxel-size", type=options.positive_float, metavar="V", help=what)
    p.add_common()
    return p


def _import(args: argparse.Namespace, console: Console) -> int:
    check_output(args.output, args.overwrite)
    from pd4dgs_codec.interchange.scaffold_gs import read_scaffold_gs

    scene = read_scaffold_gs(Path(args.input), args.appearance, args.voxel_size)
    write_checkpoint(args.output, scene, args.overwrite)
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


main = command(parser, _import)
