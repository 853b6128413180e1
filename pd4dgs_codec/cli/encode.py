"""`pd4dgs-encode`: checkpoint -> `.pd4`."""

from __future__ import annotations

import argparse
import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.common import OK, Console, Parser, UsageError, number, positive_float, run, table, use_threads
from pd4dgs_codec.cli.files import STDIO, check_output, is_pd4, read_bytes, write_bytes

if TYPE_CHECKING:
    from pd4dgs_codec.scene import Scene

DETAILS = """\
A .pd4 file holds layer 0 (static scene), layer 1 (global motion) and layer 2 (local motion) one after the other; every
prefix that ends with a layer can be shown. What has no visible effect is left out, and the report says what and why.

examples:
  pd4dgs-encode model.pt -o scene.pd4
  pd4dgs-encode model.pt -o small.pd4 --step-scale 2
  pd4dgs-encode model.pt -o - | pd4dgs-decode -"""

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
    p.add_common()
    return p


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return run(parser(), _encode, argv)


def _encode(args: argparse.Namespace, console: Console) -> int:
    if args.output == STDIO and args.json:
        raise UsageError("-o - and --json both want stdout; name an output file")
    check_output(args.output, args.overwrite)
    scene, trained = _load(args)
    console.detail(f"{args.input}: {len(scene.anchor_q)} anchors, layers {list(scene.layers)}, steps {scene.steps}")
    from pd4dgs_codec.codec.encoder import encode_with_report

    layers = args.layers if args.layers == "auto" else int(args.layers)
    data, report = encode_with_report(
        scene,
        mode=args.mode,
        deformation=args.deformation,
        priors=args.priors,
        step_scale=args.step_scale,
        layers=layers,
        effort=args.effort,
        omit=args.omit,
        verify=not args.no_verify,
    )
    result = {"input": args.input, "output": args.output, **report.json()}
    for row in result["layers"]:
        row["ratio"] = row["payload_bits"] / row["rate_bits"] if row["rate_bits"] else None
    if trained and args.json:  # shown nowhere else, and it takes its time
        result |= _train_rate(scene, layers, args.step_scale)
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


class _Stdin(io.BytesIO):
    """Bytes that call themselves stdin in a message."""

    def __str__(self) -> str:
        return "stdin"


def _train_rate(scene: Scene, layers: str | int, step_scale: float) -> dict[str, Any]:
    """The trainer's own sum of R over the float values, at the steps and for the layers of this file."""
    from dataclasses import replace

    from pd4dgs_codec.report.rate import train_rate_bits

    rows = train_rate_bits(replace(scene, steps=scene.steps.scaled(step_scale)), layers)
    per_layer = [
        {**row, "layer": int(row["layer"]), "bits": sum(bits for name, bits in row.items() if name != "layer")}
        for row in rows
    ]
    return {"train_rate_bits": sum(row["bits"] for row in per_layer), "train_rate_bits_layers": per_layer}


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
    verified = "verified" if result["verified"] else "not verified"
    name = "stdout" if result["output"] == STDIO else result["output"]
    lines.append(f"{name}: {result['bytes']:,} bytes, {verified}, {result['seconds']:.2f} s")
    lines.append(f"first frame after {first_frame:.2f} s at {FIRST_FRAME_RATE / 1e6:g} Mbps")
    return "\n".join(lines)
