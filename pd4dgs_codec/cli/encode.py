"""`pd4dgs-encode`: checkpoint -> `.pd4`."""

from __future__ import annotations

import argparse
import math
import re
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, STDIO, Console, UsageError, color, number, progress_bar, say, shown_name, table
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.options import CHOICES, DEFAULTS, EncodeOptions

if TYPE_CHECKING:
    from pd4dgs_codec.format.metadata import Metadata
    from pd4dgs_codec.kinds import AnyScene
    from pd4dgs_codec.quality.packing import Views
    from pd4dgs_codec.scene import SceneInfo, Viewpoint

DETAILS = f"""\
A .pd4 file holds layer 0 (the scene at one instant), layer 1 (its motion) and layer 2 (motion finer in time) in this
order; every prefix that ends with a layer or a slice can be shown. Parts without visible effect are omitted and listed
with reasons in the report.

--target-size fits the file, or its layers, to a size with the least loss of quality: L0=425k takes 1.7 s at 2 Mbps.
Fitting takes a minute or more, and longer with --slices.

--slices 50k lets the first frame appear after 50 kB and improve with each further slice. The anchors that matter most
in renderings come first; without target sizes others pass to a higher layer, so that motion need not wait for them.
This lowers the levels below the highest, as the report shows; --keep-levels leaves them as trained. Ordering the
anchors takes up to some minutes. A slice also holds the colour that best stands in for the Gaussians of later
slices, and a factor by which its own Gaussians are enlarged until those arrive.

Sizes and slices are measured on renderings by cameras of --data, else by training cameras in the checkpoint, else by
the file's own camera.

In the report, payload/ΣR is the ratio of coded bits to the sum of R(a), the rate model of training.

{options.SOURCES}

examples:
  pd4dgs-encode model.pt -o scene.pd4
  pd4dgs-encode model.pt -o small.pd4 --step-scale 2
  pd4dgs-encode model.pt -o early.pd4 --slices 50k --data recordings/kitchen --downscale 2
  pd4dgs-encode model.pt -o half.pd4 --target-size 300k
  pd4dgs-encode model.pt -o fast.pd4 --target-size L0=350k --data recordings/kitchen --downscale 2
  pd4dgs-encode model.pt -o - | pd4dgs-decode -"""

#: Link rate of the time to the first frame in the report, bits per second.
FIRST_FRAME_RATE = 2e6
#: Loss of a level by slices, dB, from which the report names the option that avoids it.
NOTABLE_DB = 0.1
#: Help of the options that are fields of EncodeOptions with a few choices.
HELP = {
    "mode": "entropy coder; the player supports ans only",
    "priors": "candidate distributions of each channel",
    "layers": "highest layer to keep; auto omits layers without effect",
    "effort": "compression effort, from 1 (fastest) to 9 (smallest file)",
    "omit": "omit plane cells that no anchor reads, or nothing",
}


def parser() -> options.Parser:
    p = options.Parser("encode", "model.pt -o FILE.pd4", "Encode a trained scene as a layered .pd4 file.", DETAILS)
    p.add("input model.pt", "checkpoint of pd4dgs-train, or a .pd4 file to re-encode; - reads stdin")
    p.add("-o, --output FILE.pd4", "file to write; - writes stdout", required=True)
    for name, what in HELP.items():
        p.add(
            f"--{name}", f"{what} (default: %(default)s)", _value, choices=CHOICES[name], default=vars(DEFAULTS)[name]
        )
    what = "factor on all quantisation steps; above 1, smaller and coarser files (default: %(default)g)"
    p.add("--step-scale X", what, options.positive_float, default=DEFAULTS.step_scale)
    p.add("--no-verify", "do not decode the result to verify it", dest="verify", action="store_false")
    what = "cut layers into slices: the first of at most SIZE bytes, later ones of two thirds (default: no slices)"
    p.add("--slices SIZE", what, options.size, default=DEFAULTS.slices)
    p.add("--keep-levels", "with --slices, leave every anchor in its layer, so that all levels look as without slices")
    what = "byte limit, met by coarser steps and fewer anchors: 300k of the file, L0=... of layers (0 with the header)"
    p.add("--target-size SIZE", what, options.layer_sizes, default={})
    options.add_metadata(p, "shown by pd4dgs-info and kept when a .pd4 file is re-encoded")
    views = p.group("rendered quality")
    what = "dataset, see below: training views for the sizes and slices, held-out views for the reported quality"
    views("--data SOURCE", what)
    options.add_reading(views, unset=options.READING)
    views("--views N", "use about N views of each split, evenly spread (default: 16)", options.positive_int)
    return p.add_common()


def _value(text: str) -> str | int:
    return int(text) if text.isdecimal() else text


def check_usage(args: argparse.Namespace) -> None:
    """Sets conditional defaults. Raises UsageError for options that do not fit together."""
    if args.output == STDIO and args.json:
        raise UsageError("-o - and --json both write to stdout, expected -o FILE")
    if args.output.lower().endswith(".pt"):
        common.check_other_file(args.input, args.output)
        raise UsageError(
            f"-o {args.output} names a checkpoint, expected a .pd4 file; pd4dgs-decode -o writes checkpoints"
        )
    if args.layers != "auto" and (gone := [layer for layer in args.target_size if (layer or 0) > args.layers]):
        raise UsageError(f"--target-size L{gone[0]} has no effect with --layers {args.layers}")
    if args.mode == "lzma" and args.priors != DEFAULTS.priors:
        raise UsageError("--priors has no effect with --mode lzma")
    options.conditional(args, args.slices, "needs --slices SIZE", keep_levels=False)
    options.conditional(args, args.slices or args.target_size, "needs --slices or --target-size", data=None)
    options.conditional(args, args.data, "needs --data SOURCE", **options.READING, views=16)
    try:
        args.options = EncodeOptions(**{field.name: getattr(args, field.name) for field in fields(EncodeOptions)})
    except EncodeError as error:
        raise UsageError(str(error)) from None


def _encode(args: argparse.Namespace, console: Console) -> int:
    check_usage(args)
    common.check_output(args.output, args.overwrite)
    scene, viewpoints, metadata = _load(args)
    size = f"{len(scene.anchor_q)} anchors, layers {list(scene.layers)}"
    console.detail(f"{shown_name(args.input)}: {size}, steps {scene.all_steps}")
    from pd4dgs_codec.quality.packing import Views, pack
    from pd4dgs_codec.scene import Scene

    views = _views(args, scene.info, console)
    if views is None and viewpoints:
        views = Views.remembered(viewpoints)
    elif views is None and isinstance(scene, Scene) and scene.info.camera and (args.slices or args.target_size):
        say(f"{shown_name(args.input)} holds no training cameras: its own camera measures; --data SOURCE gives others")
    packed = pack(
        scene,
        args.options,
        target_sizes=args.target_size,
        views=views,
        keep_levels=args.keep_levels,
        metadata=metadata,
        progress=lambda what: progress_bar(None, "images", what),
    )
    result = {"input": args.input, "output": args.output, **packed.json()}
    common.write_bytes(args.output, packed.data, args.overwrite)
    console.result(result, _text(result, 8 * packed.report.first_bytes / FIRST_FRAME_RATE))
    return OK


main = common.command(parser, _encode)


def _load(args: argparse.Namespace) -> tuple[AnyScene, list[Viewpoint], Metadata | None]:
    """Reads (scene, training cameras and times, metadata) from a checkpoint or a `.pd4` file, which has no cameras."""
    data = common.read_bytes(args.input)
    if common.is_pd4(data):
        from pd4dgs_codec.format.decoder import decode
        from pd4dgs_codec.format.info import metadata_of

        return decode(data), [], _metadata(args, metadata_of(data))
    common.check_other_file(args.input, args.output)
    scene, viewpoints, place = common.checkpoint_scene(args.input, data)
    return scene, viewpoints, _metadata(args, None, place)


def _metadata(args: argparse.Namespace, had: Metadata | None, place: str = "") -> Metadata | None:
    """Returns the metadata `had` of the file without what was measured on it, and with the fields replaced that were
    given as options. The source also says where the scene's 0 lies in the coordinates of its data, if not at theirs;
    it still does once replaced."""
    given = options.given(args, "title", "source", "licence")
    if had:
        found = re.search(r"0 is \S+, \S+, \S+ of the data", had.source)  # as Dataset.place
        place = found[0] if found and "source" in given else ""
        had = replace(had, quality={}, slices=())
    if place:
        given["source"] = "; ".join(filter(None, [given.get("source"), place]))
    if not given:
        return had
    from pd4dgs_codec.format.metadata import Metadata

    return replace(had or Metadata(), **given)


def _views(args: argparse.Namespace, info: SceneInfo, console: Console) -> Views | None:
    if args.data is None:
        return None
    from pd4dgs_codec.quality.packing import Views

    dataset = common.read_dataset(args.data, args, info)
    views = Views.of(dataset, args.data, args.views)
    console.detail(f"{args.data}: {len(views.fitting)} training views, {len(views.held_out)} held out")
    if not dataset.test:
        say("no held-out views: quality is measured on training views")
    return views


def _text(result: dict[str, Any], first_frame: float) -> str:
    sections = ["attributes", "planes", "weights", "masks", "symbols"]
    spent = [{s["name"]: s["payload_bits"] / 8 for s in row["streams"]} for row in result["layers"]]
    shown = [name for name in sections if any(name in streams for streams in spent)]
    rows = []
    for row, streams in zip(result["layers"], spent, strict=True):
        sizes = (row["bytes"], row["anchors"], row["position_bits"] / 8, *(streams.get(name) for name in shown))
        rows.append((row["layer"], *(number(size, 0) for size in sizes), number(row["ratio"], 4)))
    heads = (name.replace("_", " ") for name in shown)
    lines = [table(("layer", "bytes", "anchors", "positions", *heads, "payload/ΣR"), rows)]
    for item in result["left_out"]:
        exactly = ", without effect" if item["lossless"] else ""
        lines.append(f"left out: {item['what']} ({item['bytes']:,} bytes{exactly}): {item['why']}")
    if "target" in result:
        lines += _target_lines(result["target"])
    if "slices" in result:
        lines += _slice_lines(result)
    verified = "verified" if result["verified"] else "not verified"
    lines.append(
        f"{shown_name(result['output'], 'stdout')}: {result['bytes']:,} bytes, {verified}, {result['seconds']:.2f} s"
    )
    lines.append(f"first frame after {first_frame:.2f} s at {FIRST_FRAME_RATE / 1e6:g} Mbps")
    return "\n".join(lines)


def _slice_lines(result: dict[str, Any]) -> list[str]:
    about = result["slices"]
    sizes = [[row["bytes"] for row in layer["slices"]] for layer in result["layers"]]
    lines = [
        f"layer {layer['layer']}: slices of {', '.join(f'{size:,}' for size in own)} bytes"
        for layer, own in zip(result["layers"], sizes, strict=True)
    ]
    if over := [row["layer"] for row, own in zip(result["layers"], sizes, strict=True) if own[0] > about["size"]]:
        what = "networks, planes and tracks are not cut"
        lines.append(f"first slices of layers {over} exceed {about['size']:,} bytes: {what}")
    seen = f" on {about['pictures']} views: {about['cameras']}" if about["pictures"] else ""
    seen = ": the file has no camera" if about["order"].startswith("gate") else seen
    lines.append(f"anchors ordered by {about['order']}{seen}")
    fills = [row["fill"] for layer in result["layers"] for row in layer["slices"]]
    if any(fills):
        lines.append(f"fill and spread of each slice: {', '.join(map(color, fills))} (-: the background)")
    if "psnr" in about:
        lines.append(f"mPSNR after each slice: {', '.join(f'{db:.2f}' for db in about['psnr'])} dB on held-out views")
    for row in about.get("levels", ()):
        found = f"{row['mpsnr']:.2f} dB with slices, {row['mpsnr_unsliced']:.2f} dB without"
        lines.append(f"level {row['level']}: {found}, on {about['against']}")
    if any(row["mpsnr_unsliced"] - row["mpsnr"] > NOTABLE_DB for row in about.get("levels", ())):
        lines.append("lower levels have fewer anchors than without slices; --keep-levels leaves levels as trained")
    return lines


def _target_lines(target: dict[str, Any]) -> list[str]:
    lines = []
    for row in target["layers"]:
        coarser = [f"{name} x{factor:.2f}" for name, factor in row["factors"].items() if factor != 1]
        where = "left out" if row["to_layer"] is None else f"moved to layer {row['to_layer']}"
        moved = [f"{row['moved']:,} anchors {where}"] if row["moved"] else []
        how = "; ".join([", ".join(coarser), *moved] if coarser else moved) or "unchanged"
        what = "file" if row["layer"] is None else f"layer {row['layer']}"
        lines.append(f"{what}: {row['bytes']:,} bytes, target {row['target']:,}: {how}")
    for row in target["levels"]:
        error = "none" if row["error_psnr"] == math.inf else f"{row['error_psnr']:.2f} dB PSNR"
        truth = f", {row['lost_db']:+.3f} dB loss on held-out views" if "lost_db" in row else ""
        lines.append(f"level {row['level']}: quantisation error {error}{truth}")
    return lines + [f"fitted on {target['pictures']} renderings: {target['cameras']}"]
