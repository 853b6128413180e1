"""`pd4dgs-decode`: `.pd4` -> arrays, a checkpoint, or a check of every byte."""

from __future__ import annotations

import argparse
import io
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import values
from pd4dgs_codec.cli.common import OK, PARTIAL, Console, Parser, UsageError, command, number, table
from pd4dgs_codec.cli.files import STDIO, check_output, read_bytes, write_bytes, write_checkpoint
from pd4dgs_codec.errors import DeliveryError

if TYPE_CHECKING:
    from pd4dgs_codec.scene import Scene

DETAILS = """\
Without -o the file is decoded and checked, and a summary printed. An .npz file holds the float32 arrays anchor,
feature, scaling_log, offset, mask_L, mlp.*, planes.* and meta_*; a .pt file is a checkpoint that encode, render and
eval accept. Of a URL (http, https) only the layers asked for are fetched; cut connections are taken up again.

examples:
  pd4dgs-decode scene.pd4
  pd4dgs-decode http://127.0.0.1:8000/scene.pd4 --max-layer 1 -o prefix.npz
  pd4dgs-decode scene.pd4 --max-layer 0 -o base.npz
  pd4dgs-decode scene.pd4 --max-bytes 100k -o early.npz
  head -c 300000 scene.pd4 | pd4dgs-decode - --allow-partial -o prefix.pt"""


def parser() -> Parser:
    """The options of `pd4dgs-decode`."""
    p = Parser("decode", "[scene.pd4] [-o FILE]", "Unpack a .pd4 file, or the first layers of one.", DETAILS)
    what = "file or URL to read; - or nothing reads stdin"
    p.add_argument("input", nargs="?", default=STDIO, metavar="scene.pd4", help=what)
    what = "FILE.npz or FILE.pt; - writes npz to stdout; without it only check"
    p.add_argument("-o", "--output", metavar="FILE", help=what)
    p.add_argument("--max-layer", type=int, choices=(0, 1, 2), help="stop after this layer")
    p.add_argument(
        "--max-bytes", type=values.size, metavar="SIZE", help="stop after SIZE bytes, such as 50k, at a slice"
    )
    what = "with .npz: add the integers (NAME_q) and their steps (NAME_step)"
    p.add_argument("--symbols", action="store_true", help=what)
    what = "decode as many layers of a cut file as are whole; exit 3 then"
    p.add_argument("--allow-partial", action="store_true", help=what)
    p.add_common()
    return p


def _decode(args: argparse.Namespace, console: Console) -> int:
    kind = _output_kind(args)
    if args.output:
        check_output(args.output, args.overwrite)
    data = _input(args, console)
    from pd4dgs_codec.format.decoder import decode_partial

    start = time.perf_counter()
    scene, complete = decode_partial(
        data, max_layer=args.max_layer, max_bytes=args.max_bytes, allow_partial=args.allow_partial
    )
    seconds = time.perf_counter() - start
    console.detail(f"steps {scene.steps}")
    if kind == ".pt":
        write_checkpoint(args.output, scene, args.overwrite)
    elif kind == ".npz":
        write_bytes(args.output, _npz(scene, args.symbols), args.overwrite)
    if not complete:
        console.message(f"pd4dgs-decode: the input is cut; decoded the layers {list(scene.layers)}")
    result = _summary(scene, data, complete, seconds, args)
    console.result(result, _text(result), on_stdout=not args.output)
    return OK if complete else PARTIAL


main = command(parser, _decode)


def _input(args: argparse.Namespace, console: Console) -> bytes:
    """The file's bytes; of a URL only those that --max-layer and --max-bytes need."""
    from pd4dgs_codec.web.urls import is_url

    if not is_url(args.input):
        return read_bytes(args.input)
    from pd4dgs_codec.web.prefix import fetch
    from pd4dgs_codec.web.transfer import Transfer

    with closing(Transfer(args.input)) as transfer:
        try:
            data = fetch(transfer, args.max_layer, args.max_bytes)
        except DeliveryError as error:
            if not (args.allow_partial and transfer.data):
                raise
            console.message(f"pd4dgs-decode: {error}")
            data = bytes(transfer.data)
    console.detail(f"{len(transfer.data):,} bytes in {transfer.requests} requests, {transfer.cuts} cuts")
    return data


def _output_kind(args: argparse.Namespace) -> str | None:
    """ ".npz", ".pt", or None without an output."""
    if args.output is None:
        if args.symbols:
            raise UsageError("--symbols needs -o FILE.npz")
        return None
    if args.output == STDIO:
        if args.json:
            raise UsageError("-o - and --json both want stdout; name an output file")
        return ".npz"
    kind = Path(args.output).suffix
    if kind not in (".npz", ".pt"):
        raise UsageError(f"found -o {args.output}, expected a name that ends in .npz or .pt")
    if args.symbols and kind == ".pt":
        raise UsageError("--symbols needs -o FILE.npz; a checkpoint holds no symbols")
    return kind


def _npz(scene: Scene, symbols: bool) -> bytes:
    import numpy as np

    from pd4dgs_codec.format.npz import to_npz_dict

    stream = io.BytesIO()
    np.savez(stream, **to_npz_dict(scene, symbols))  # type: ignore[arg-type]
    return stream.getvalue()


def _summary(scene: Scene, data: bytes, complete: bool, seconds: float, args: argparse.Namespace) -> dict[str, Any]:
    from pd4dgs_codec.format.info import info

    described = {row["layer"]: row for row in info(data)["layers"]}
    rows = []
    for i, (layer, total) in enumerate(zip(scene.layers, scene.rows, strict=True)):
        ends = [part["end"] for part in described[layer]["slices"]]
        end = max(end for end in ends if end == ends[0] or args.max_bytes is None or end <= args.max_bytes)
        size = sum(part["bytes"] for part in described[layer]["slices"] if part["end"] <= end)
        place = {"offset": described[layer]["offset"], "bytes": size, "end": end}
        anchors = total - (scene.rows[i - 1] if i else 0)
        rows.append({"layer": layer, **place, "anchors": anchors, "active": int((scene.mask[i] > 0).sum())})
    wanted = range(3 if args.max_layer is None else args.max_layer + 1)
    return {
        "input": args.input,
        "output": args.output,
        "bytes": len(data),
        "complete": complete,
        "max_layer": args.max_layer,
        "max_bytes": args.max_bytes,
        "seconds": round(seconds, 4),
        "anchors": len(scene.anchor_q),
        "global_deformation": scene.global_deformation is not None,
        "local_deformation": scene.local_deformation is not None,
        "layers": rows,
        "absent": [layer for layer in wanted if layer not in described],
    }


def _text(result: dict[str, Any]) -> str:
    rows = [
        (row["layer"], *(number(row[key], 0) for key in ("bytes", "end", "anchors", "active")))
        for row in result["layers"]
    ]
    if not result["complete"]:
        state = "cut; valid so far"
    elif result["max_bytes"] is not None:
        state = f"valid in the first {result['layers'][-1]['end']:,}"
    elif result["max_layer"] is not None:  # what follows the prefix was not looked at
        state = f"layers {', '.join(str(row['layer']) for row in result['layers'])} whole and valid"
    else:
        state = "whole and valid"
    name = "stdin" if result["input"] == STDIO else result["input"]
    lines = [
        f"{name}: {result['bytes']:,} bytes, {state}, decoded in {result['seconds']:.3f} s",
        table(("layer", "bytes", "prefix", "new anchors", "active"), rows),
    ]
    lines += [
        f"absent: layer {layer}, which this file does without; its level looks like the one below"
        for layer in result["absent"]
    ]
    if result["output"]:
        lines.append(f"wrote {'stdout' if result['output'] == STDIO else result['output']}")
    return "\n".join(lines)
