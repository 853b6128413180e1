"""`pd4dgs-encode`: checkpoint -> `.pd4`."""

from __future__ import annotations

import argparse
import io
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.common import (
    OK,
    SOURCES,
    Console,
    Parser,
    UsageError,
    count,
    layer_sizes,
    non_negative_float,
    number,
    positive_float,
    positive_int,
    run,
    table,
    use_threads,
)
from pd4dgs_codec.cli.files import STDIO, check_output, is_pd4, read_bytes, write_bytes
from pd4dgs_codec.cli.progress import progress_bar

if TYPE_CHECKING:
    from pd4dgs_codec.codec.omissions import LeftOut
    from pd4dgs_codec.data.view import View
    from pd4dgs_codec.scene import Scene

DETAILS = f"""\
A .pd4 file holds layer 0 (static scene), layer 1 (global motion) and layer 2 (local motion) one after the other; every
prefix that ends with a layer can be shown. What has no visible effect is left out, and the report says what and why.

--target-size makes layers small enough for a link with the least loss in the pictures: 425k for layer 0 is 1.7 s at
2 Mbps. It takes a minute or more. Give --data, or only what the file's own camera shows is judged.

{SOURCES}

examples:
  pd4dgs-encode model.pt -o scene.pd4
  pd4dgs-encode model.pt -o small.pd4 --step-scale 2
  pd4dgs-encode model.pt -o fast.pd4 --target-size L0=350k --data recordings/kitchen --downscale 2
  pd4dgs-encode model.pt -o - | pd4dgs-decode -"""

#: Below this gain of a level a layer is left out, dB per megabyte (1e6 bytes). About 0.5 dB is what viewers begin to
#: notice, and half a megabyte takes 2 s at 2 Mbps, as long as all of such a scene should.
MIN_GAIN = 1.0
#: Pictures of the file's own camera, and how many degrees it sways, where there is no dataset.
OWN_PICTURES, OWN_ORBIT = 16, 20.0
#: Link rate at which the report states the time to the first frame, in bits per second.
FIRST_FRAME_RATE = 2e6


def parser() -> Parser:
    """The options of `pd4dgs-encode`."""
    p = Parser("encode", "model.pt -o FILE.pd4", "Pack a trained scene into a layered .pd4 file.", DETAILS)
    p.add_argument(
        "input", metavar="model.pt", help="checkpoint of pd4dgs-train, or a .pd4 file to pack again; - reads stdin"
    )
    p.add_argument("-o", "--output", required=True, metavar="FILE.pd4", help="file to write; - writes stdout")
    p.add_argument("--mode", choices=("ans", "lzma"), default="ans", help="entropy coder (default: ans)")
    p.add_argument(
        "--deformation",
        choices=("coded", "float32"),
        default="coded",
        help="planes and networks of layers 1 and 2: coded integers, or float32 under LZMA (default: coded)",
    )
    p.add_argument(
        "--priors",
        choices=("best", "gauss"),
        default="best",
        help="distributions to choose from per channel (default: best)",
    )
    p.add_argument(
        "--step-scale",
        type=positive_float,
        default=1.0,
        metavar="X",
        help="multiply every quantisation step: above 1 smaller and coarser (default: 1)",
    )
    p.add_argument(
        "--layers",
        choices=("auto", "0", "1", "2"),
        default="auto",
        help="auto leaves out layers without effect; a number keeps the layers up to it (default: auto)",
    )
    p.add_argument(
        "--effort", type=int, choices=range(1, 10), default=5, metavar="1-9", help="1 fast, 9 small (default: 5)"
    )
    p.add_argument(
        "--omit",
        choices=("bounded", "lossless", "nothing"),
        default="bounded",
        help="leave out what changes no picture and residuals too small to see, the former alone, or nothing "
        "(default: bounded)",
    )
    p.add_argument("--no-verify", action="store_true", help="skip decoding the result and comparing every symbol")
    p.add_argument(
        "--target-size",
        type=layer_sizes,
        default={},
        metavar="L0=425k,...",
        help="most bytes that each layer may add to the file (layer 0 with the header): coarser steps, fewer anchors",
    )
    views = p.add_argument_group("judging by pictures")
    views.add_argument(
        "--data",
        metavar="SOURCE",
        help="a dataset, see above: sizes are fitted on its training views, layers must pay on those held out",
    )
    views.add_argument(
        "--downscale", type=positive_int, default=1, metavar="K", help="pictures 1/K as wide and high (default: 1)"
    )
    views.add_argument("--holdout", type=count, default=8, metavar="K", help="as in pd4dgs-train (default: 8)")
    views.add_argument(
        "--views",
        type=positive_int,
        default=16,
        metavar="N",
        help="use about N of its views of either kind, evenly spread (default: 16)",
    )
    views.add_argument(
        "--min-gain",
        type=non_negative_float,
        metavar="DB",
        help="with --data, leave out layers whose level gains less than DB dB mPSNR per megabyte "
        f"(default: {MIN_GAIN:g}; 0: keep all)",
    )
    p.add_common()
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(parser(), _encode, argv)


def _encode(args: argparse.Namespace, console: Console) -> int:
    if args.output == STDIO and args.json:
        raise UsageError("-o - and --json both want stdout; name an output file")
    if args.min_gain is not None and args.data is None:
        raise UsageError("--min-gain needs --data SOURCE: a gain is measured on its views")
    check_output(args.output, args.overwrite)
    scene, trained = _load(args)
    console.detail(f"{args.input}: {len(scene.anchor_q)} anchors, layers {list(scene.layers)}, steps {scene.steps}")
    from dataclasses import replace

    from pd4dgs_codec.codec.encoder import encode_with_report

    scene = replace(scene, steps=scene.steps.scaled(args.step_scale))
    layers = args.layers if args.layers == "auto" else int(args.layers)
    options = {
        "mode": args.mode,
        "deformation": args.deformation,
        "priors": args.priors,
        "layers": layers,
        "effort": args.effort,
    }
    views, held_out = _views(args, console)
    left_out: list[LeftOut] = []
    min_gain = MIN_GAIN if args.min_gain is None else args.min_gain
    if held_out and layers == "auto" and min_gain:
        scene, left_out = _leave_out_unpaid(args, scene, held_out, min_gain)
    target = None
    if args.target_size:
        scene, more, target = _fit(args, scene, views, held_out, options)
        left_out += more
    data, report = encode_with_report(scene, omit=args.omit, verify=not args.no_verify, left_out=left_out, **options)
    result = {"input": args.input, "output": args.output, **report.json()}
    if target is not None:
        added = _added_bytes(data)
        for row in target["layers"]:
            row["bytes"] = added.get(row["layer"], 0)
        result["target"] = target
    for row in result["layers"]:
        row["ratio"] = row["payload_bits"] / row["rate_bits"] if row["rate_bits"] else None
    if trained and args.json:  # shown nowhere else, and it takes its time
        result |= _train_rate(scene, layers)
        bits = {row["layer"]: row["bits"] for row in result["train_rate_bits_layers"]}
        for row in result["layers"]:  # float32 deformations may keep a layer that is zero once quantised
            row["train_rate_bits"] = bits.get(row["layer"])
    write_bytes(args.output, data, args.overwrite)
    console.result(result, _text(result, _first_frame_seconds(data)), on_stdout=False)
    return OK


def _load(args: argparse.Namespace) -> tuple[Scene, bool]:
    """(scene, whether it holds a checkpoint's own floats: those of a .pd4 are gone). Only a checkpoint needs torch."""
    data = read_bytes(args.input)
    if is_pd4(data):
        from pd4dgs_codec.codec.decoder import decode

        return decode(data), False
    use_threads(args)
    from pd4dgs_codec.model import checkpoint
    from pd4dgs_codec.model.convert import to_scene

    model, _ = checkpoint.load(args.input if args.input != STDIO else _Stdin(data))  # type: ignore[arg-type]
    return to_scene(model), True


def _views(args: argparse.Namespace, console: Console) -> tuple[list[View], list[View]]:
    """About --views of --data's training views and as many held out (training views if none are), evenly spread.

    A layer is judged by what it was not fitted to: on training views a useless one may still gain a lot.
    """
    if args.data is None:
        return [], []
    use_threads(args)
    from pd4dgs_codec.data.dataset import load

    dataset = load(args.data, downscale=args.downscale, holdout=args.holdout)
    train, test = (
        list(views[:: -(-len(views) // args.views)]) for views in (dataset.train, dataset.test or dataset.train)
    )
    console.detail(f"{args.data}: {len(train)} training views, {len(test)} to judge by")
    if not dataset.test:
        console.message("no views are held out: layers are judged on training views")
    return train, test


def _leave_out_unpaid(
    args: argparse.Namespace, scene: Scene, views: list[View], min_gain: float
) -> tuple[Scene, list[LeftOut]]:
    """The scene without the layers whose level does not pay, and what went."""
    from pd4dgs_codec.codec.layers import Coding
    from pd4dgs_codec.pack.worth import leave_out_unpaid

    coding = Coding(args.mode, args.priors, args.effort)
    with progress_bar(None, "pictures", "judging layers") as step:
        return leave_out_unpaid(
            scene,
            views,
            min_gain=min_gain,
            coding=coding,
            raw_deformation=args.deformation == "float32",
            step=step,
        )


def _fit(
    args: argparse.Namespace, scene: Scene, views: list[View], held_out: list[View], options: dict[str, Any]
) -> tuple[Scene, list[LeftOut], dict[str, Any]]:
    """(scene whose layers meet --target-size, what that leaves out, the "target" of the report)."""
    use_threads(args)
    from dataclasses import asdict

    from pd4dgs_codec.codec.plan import plan
    from pd4dgs_codec.codec.symbols import rounded
    from pd4dgs_codec.pack.rendered import RenderedLoss, psnr_of, true_psnr
    from pd4dgs_codec.pack.target import fit
    from pd4dgs_codec.view.frames import dataset_frames, own_frames

    raw = args.deformation == "float32"
    scene, left_out = plan(scene, options["layers"], raw, args.omit)
    frames = dataset_frames(views) if views else own_frames(scene.info, OWN_PICTURES, OWN_ORBIT, args.downscale)
    with progress_bar(None, "pictures", "fitting sizes") as step:
        loss = RenderedLoss(scene, frames, step)
        fitted, dropped, fits = fit(scene, args.target_size, loss.mean_mse, loss.harm, **options)
        packed = rounded(plan(fitted, options["layers"], raw, "nothing")[0], raw)
        errors = loss.mse(packed)
        before, after = (true_psnr(s, held_out, step) if views else {} for s in (scene, packed))
    levels = []
    for level, mse in errors.items():
        lost = {"lost_db": before[level] - after[level]} if views else {}
        levels.append({"level": level, "error_psnr": psnr_of(mse), **lost})
    report = {
        "cameras": f"training views of {args.data}" if views else "the file's own camera",
        "pictures": len(frames),
        "layers": [{**asdict(row), "steps": {k: getattr(fitted.steps, k) for k in row.factors}} for row in fits],
        "levels": levels,
    }
    return fitted, left_out + dropped, report


class _Stdin(io.BytesIO):
    """Bytes that call themselves stdin in a message."""

    def __str__(self) -> str:
        return "stdin"


def _train_rate(scene: Scene, layers: str | int) -> dict[str, Any]:
    """The trainer's own sum of R over the float values, at the steps and for the layers of this file."""
    from pd4dgs_codec.pack.train_rate import train_rate_bits

    rows = train_rate_bits(scene, layers)
    per_layer = [
        {**row, "layer": int(row["layer"]), "bits": sum(bits for name, bits in row.items() if name != "layer")}
        for row in rows
    ]
    return {"train_rate_bits": sum(row["bits"] for row in per_layer), "train_rate_bits_layers": per_layer}


def _added_bytes(data: bytes) -> dict[int, int]:
    """By layer what it adds to the file, the header counted with layer 0."""
    from pd4dgs_codec.codec.info import info

    rows = info(data)["layers"]
    ends = [0, *(row["end"] for row in rows)]
    return {row["layer"]: row["end"] - before for row, before in zip(rows, ends, strict=False)}


def _first_frame_seconds(data: bytes) -> float:
    from pd4dgs_codec.codec.info import info

    return 8 * info(data)["layers"][0]["end"] / FIRST_FRAME_RATE


def _text(result: dict[str, Any], first_frame: float) -> str:
    sections = ["attributes", "planes", "weights", "masks", "symbols", "floats"]
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
    lines = [table(("layer", "bytes", "anchors", "positions", *shown, "payload/ΣR"), rows)]
    for item in result["left_out"]:
        exactly = ", changes no picture" if item["lossless"] else ""
        lines.append(f"left out: {item['what']} ({item['bytes']:,} bytes{exactly}): {item['why']}")
    if "target" in result:
        lines += _target_lines(result["target"])
    verified = "verified" if result["verified"] else "not verified"
    name = "stdout" if result["output"] == STDIO else result["output"]
    lines.append(f"{name}: {result['bytes']:,} bytes, {verified}, {result['seconds']:.2f} s")
    lines.append(f"first frame after {first_frame:.2f} s at {FIRST_FRAME_RATE / 1e6:g} Mbps")
    return "\n".join(lines)


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
