"""`pd4dgs-encode`: checkpoint -> `.pd4`."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import (
    OK,
    STDIO,
    Console,
    UsageError,
    check_output,
    checkpoint_scene,
    command,
    is_pd4,
    number,
    read_bytes,
    read_dataset,
    table,
    write_bytes,
)
from pd4dgs_codec.cli.progress import progress_bar
from pd4dgs_codec.format.options import CHOICES, DEFAULTS, EncodeOptions
from pd4dgs_codec.quality import MIN_GAIN_PER_MEGABYTE

if TYPE_CHECKING:
    from pd4dgs_codec.format.metadata import Metadata
    from pd4dgs_codec.quality.packing import Packed, Views
    from pd4dgs_codec.scene import Scene

DETAILS = f"""\
A .pd4 file holds layer 0 (static scene), layer 1 (global motion) and layer 2 (local motion) one after the other; every
prefix that ends with a layer can be shown. What has no visible effect is left out, and the report says what and why.

--target-size makes layers small enough for a link with the least loss in the pictures: 425k for layer 0 is 1.7 s at
2 Mbps. It takes a minute or more. Give --data, or only what the file's own camera shows is judged.

--slices 50k lets a picture appear after the first 50 kB and improve with each further slice. It takes minutes as well,
and the same pictures decide which anchors come first.

{options.SOURCES}

examples:
  pd4dgs-encode model.pt -o scene.pd4
  pd4dgs-encode model.pt -o small.pd4 --step-scale 2
  pd4dgs-encode model.pt -o early.pd4 --slices 50k --data recordings/kitchen --downscale 2
  pd4dgs-encode model.pt -o fast.pd4 --target-size L0=350k --data recordings/kitchen --downscale 2
  pd4dgs-encode model.pt -o - | pd4dgs-decode -"""

#: Link rate at which the report states the time to the first frame, in bits per second.
FIRST_FRAME_RATE = 2e6


def parser() -> options.Parser:
    """The options of `pd4dgs-encode`."""
    p = options.Parser("encode", "model.pt -o FILE.pd4", "Pack a trained scene into a layered .pd4 file.", DETAILS)
    what = "checkpoint of pd4dgs-train, or a .pd4 file to pack again; - reads stdin"
    p.add_argument("input", metavar="model.pt", help=what)
    p.add_argument("-o", "--output", required=True, metavar="FILE.pd4", help="file to write; - writes stdout")
    _add_choice(p, "mode", "entropy coder")
    _add_choice(p, "priors", "distributions to choose from per channel")
    what = "multiply every quantisation step: above 1 smaller and coarser (default: %(default)g)"
    p.add_argument("--step-scale", type=options.positive_float, default=DEFAULTS.step_scale, metavar="X", help=what)
    _add_choice(p, "layers", "auto leaves out layers without effect; a number keeps the layers up to it")
    efforts = CHOICES["effort"]
    _add_choice(p, "effort", f"{efforts[0]} fast, {efforts[-1]} small", type=int, metavar=f"{efforts[0]}-{efforts[-1]}")
    _add_choice(
        p, "omit", "leave out what changes no picture and residuals too small to see, the former alone, or nothing"
    )
    p.add_argument("--no-verify", action="store_true", help="skip decoding the result and comparing every symbol")
    what = (
        "cut layers into slices of SIZE bytes, where planes and networks allow it; what pictures need most comes first"
    )
    p.add_argument("--slices", type=options.size, default=DEFAULTS.slices, metavar="SIZE", help=what)
    what = "most bytes that each layer may add to the file (layer 0 with the header): coarser steps, fewer anchors"
    p.add_argument("--target-size", type=options.layer_sizes, default={}, metavar="L0=425k,...", help=what)
    about = p.add_argument_group(
        "what the file says about itself", "shown by pd4dgs-info; a .pd4 that is packed again keeps it"
    )
    for name, what in (("title", "of the scene"), ("source", "what it was made of"), ("licence", "its terms of use")):
        about.add_argument(f"--{name}", metavar="TEXT", help=what)
    views = p.add_argument_group("judging by pictures")
    what = "a dataset, see below: sizes are fitted on its training views, layers must pay on those held out"
    views.add_argument("--data", metavar="SOURCE", help=what)
    options.add_reading(views)
    what = "use about N of its views of either kind, evenly spread (default: 16)"
    views.add_argument("--views", type=options.positive_int, default=16, metavar="N", help=what)
    views.add_argument(
        "--min-gain",
        type=options.non_negative_float,
        metavar="DB",
        help="with --data, leave out layers whose level gains less than DB dB mPSNR per megabyte "
        f"(default: {MIN_GAIN_PER_MEGABYTE:g}; 0: keep all)",
    )
    p.add_common()
    return p


def _add_choice(p: options.Parser, name: str, what: str, **settings: Any) -> None:
    """--NAME with the choices and the default of that field of EncodeOptions."""
    default = vars(DEFAULTS)[name]
    choices = tuple(CHOICES[name]) if "type" in settings else tuple(map(str, CHOICES[name]))
    flag = f"--{name.replace('_', '-')}"
    p.add_argument(flag, choices=choices, default=default, help=f"{what} (default: {default})", **settings)


def _encode(args: argparse.Namespace, console: Console) -> int:
    if args.output == STDIO and args.json:
        raise UsageError("-o - and --json both want stdout; name an output file")
    if args.min_gain is not None and args.data is None:
        raise UsageError("--min-gain needs --data SOURCE: a gain is measured on its views")
    check_output(args.output, args.overwrite)
    options = _options(args)
    scene, trained, metadata = _load(args)
    console.detail(f"{args.input}: {len(scene.anchor_q)} anchors, layers {list(scene.layers)}, steps {scene.steps}")
    from pd4dgs_codec.quality.packing import pack

    packed = pack(
        scene,
        options,
        target_sizes=args.target_size,
        views=_views(args, console),
        min_gain=MIN_GAIN_PER_MEGABYTE if args.min_gain is None else args.min_gain,
        downscale=args.downscale,
        metadata=metadata,
        progress=lambda what: progress_bar(None, "pictures", what),
    )
    result = {"input": args.input, "output": args.output, **packed.json()}
    if trained and args.json:  # shown nowhere else, and it takes its time
        _add_train_rate(result, packed, options)
    write_bytes(args.output, packed.data, args.overwrite)
    console.result(result, _text(result, 8 * packed.report.first_bytes / FIRST_FRAME_RATE))
    return OK


main = command(parser, _encode)


def _options(args: argparse.Namespace) -> EncodeOptions:
    return EncodeOptions(
        mode=args.mode,
        priors=args.priors,
        layers=args.layers if args.layers == "auto" else int(args.layers),
        effort=args.effort,
        omit=args.omit,
        step_scale=args.step_scale,
        slices=args.slices,
        verify=not args.no_verify,
    )


def _load(args: argparse.Namespace) -> tuple[Scene, bool, Metadata | None]:
    """(scene, whether it holds a checkpoint's own floats: those of a .pd4 are gone, metadata)."""
    data = read_bytes(args.input)
    if is_pd4(data):
        from pd4dgs_codec.format.decoder import decode
        from pd4dgs_codec.format.info import metadata_of

        return decode(data), False, _metadata(args, metadata_of(data))
    return checkpoint_scene(args.input, data), True, _metadata(args, None)


def _metadata(args: argparse.Namespace, had: Metadata | None) -> Metadata | None:
    """What the options say, in place of what the file had."""
    given = {name: vars(args)[name] for name in ("title", "source", "licence") if vars(args)[name] is not None}
    if not given:
        return had
    from pd4dgs_codec.format.metadata import Metadata

    return replace(had or Metadata(), **given)


def _views(args: argparse.Namespace, console: Console) -> Views | None:
    if args.data is None:
        return None
    from pd4dgs_codec.quality.packing import Views

    dataset = read_dataset(args.data, args)
    views = Views.of(dataset, args.data, args.views)
    console.detail(f"{args.data}: {len(views.fitting)} training views, {len(views.held_out)} to judge by")
    if not dataset.test:
        console.message("no views are held out: layers are judged on training views")
    return views


def _add_train_rate(result: dict[str, Any], packed: Packed, options: EncodeOptions) -> None:
    """The trainer's own sum of R over the float values, at the steps and for the layers of this file."""
    from pd4dgs_codec.quality.train_rate import train_rate_bits

    coded = EncodeOptions(layers=options.layers, effort=options.effort, omit=options.omit)
    rows = train_rate_bits(packed.scene, coded)
    per_layer = [
        {**row, "layer": int(row["layer"]), "bits": sum(bits for name, bits in row.items() if name != "layer")}
        for row in rows
    ]
    bits = {row["layer"]: row["bits"] for row in per_layer}
    result |= {"train_rate_bits": sum(bits.values()), "train_rate_bits_layers": per_layer}
    for row in result["layers"]:
        row["train_rate_bits"] = bits.get(row["layer"])


def _text(result: dict[str, Any], first_frame: float) -> str:
    sections = ["attributes", "planes", "weights", "masks", "symbols"]
    spent = [{s["name"]: s["payload_bits"] / 8 for s in row["streams"]} for row in result["layers"]]
    shown = [name for name in sections if any(name in streams for streams in spent)]
    rows = [
        (
            row["layer"],
            number(row["bytes"], 0),
            number(row["anchors"], 0),
            number(row["position_bits"] / 8, 0),
            *(number(streams.get(name), 0) for name in shown),
            number(row["ratio"], 4),
        )
        for row, streams in zip(result["layers"], spent, strict=True)
    ]
    heads = (name.replace("_", " ") for name in shown)
    lines = [table(("layer", "bytes", "anchors", "positions", *heads, "payload/ΣR"), rows)]
    for item in result["left_out"]:
        exactly = ", changes no picture" if item["lossless"] else ""
        lines.append(f"left out: {item['what']} ({item['bytes']:,} bytes{exactly}): {item['why']}")
    if "target" in result:
        lines += _target_lines(result["target"])
    if "slices" in result:
        lines += _slice_lines(result)
    verified = "verified" if result["verified"] else "not verified"
    name = "stdout" if result["output"] == STDIO else result["output"]
    lines.append(f"{name}: {result['bytes']:,} bytes, {verified}, {result['seconds']:.2f} s")
    lines.append(f"first frame after {first_frame:.2f} s at {FIRST_FRAME_RATE / 1e6:g} Mbps")
    return "\n".join(lines)


def _slice_lines(result: dict[str, Any]) -> list[str]:
    about = result["slices"]
    sizes = [[row["bytes"] for row in layer["slices"]] for layer in result["layers"]]
    lines = [
        f"layer {layer['layer']}: slices of {', '.join(f'{size:,}' for size in own)} bytes"
        for layer, own in zip(result["layers"], sizes, strict=True)
    ]
    seen = f" on {about['pictures']} pictures: {about['cameras']}" if about["pictures"] else ": the file has no camera"
    lines.append(f"anchors ordered by {about['order']}{seen}")
    if "psnr" in about:
        lines.append(f"mPSNR after each slice: {', '.join(f'{db:.2f}' for db in about['psnr'])} dB on held-out views")
    return lines


def _target_lines(target: dict[str, Any]) -> list[str]:
    lines = []
    for row in target["layers"]:
        coarser = [f"{name} x{factor:.2f}" for name, factor in row["factors"].items() if factor != 1]
        where = "left out" if row["to_layer"] is None else f"moved to layer {row['to_layer']}"
        moved = [f"{row['moved']:,} anchors {where}"] if row["moved"] else []
        how = "; ".join([", ".join(coarser), *moved] if coarser else moved) or "as it was"
        lines.append(f"layer {row['layer']}: {row['bytes']:,} bytes, at most {row['target']:,} wanted: {how}")
    for row in target["levels"]:
        error = "none" if row["error_psnr"] == math.inf else f"{row['error_psnr']:.2f} dB PSNR"
        truth = f", {row['lost_db']:+.3f} dB lost on held-out views" if "lost_db" in row else ""
        lines.append(f"level {row['level']}: error against the unquantised scene {error}{truth}")
    return lines + [f"fitted on {target['pictures']} pictures: {target['cameras']}"]
