"""`pd4dgs-decode`: `.pd4` -> arrays, a checkpoint, or a check of every byte."""

from __future__ import annotations

import argparse
import io
import time
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, PARTIAL, STDIO, Console, UsageError, number, shown_name, table
from pd4dgs_codec.errors import DeliveryError

if TYPE_CHECKING:
    from pd4dgs_codec.scene import Scene

DETAILS = """\
Without -o the file is decoded and checked, and a summary is printed.
An .npz file holds the float32 arrays anchor, feature, scaling_log, offset, mask_L, mlp.*, planes.* and meta_*.
A .pt file is a checkpoint that encode, render and eval accept.
From a URL (http, https) only the layers asked for are fetched; interrupted transfers resume.

examples:
  pd4dgs-decode scene.pd4
  pd4dgs-decode http://127.0.0.1:8000/scene.pd4 --max-layer 1 -o prefix.npz
  pd4dgs-decode scene.pd4 --max-layer 0 -o base.npz
  pd4dgs-decode scene.pd4 --max-bytes 100k -o early.npz
  head -c 300000 scene.pd4 | pd4dgs-decode - --allow-partial -o prefix.pt

exit code 3: cut input, decoded as far as possible (--allow-partial)"""


def parser() -> options.Parser:
    p = options.Parser("decode", "[scene.pd4] [-o FILE]", "Unpack a .pd4 file, or its first layers.", DETAILS)
    add = p.add_argument
    add("input", nargs="?", default=STDIO, metavar="scene.pd4", help="file or URL; - or nothing reads stdin")
    add("-o", "--output", metavar="FILE", help="FILE.npz or FILE.pt; - writes npz to stdout (default: only check)")
    options.add_max_layer(p, "stop after this layer")
    add("--max-bytes", type=options.size, metavar="SIZE", help="stop at the last slice within SIZE bytes, such as 50k")
    add("--symbols", action="store_true", help="with .npz: add the integers (NAME_q) and their steps (NAME_step)")
    add("--allow-partial", action="store_true", help="decode the whole layers of a cut file, and exit with 3")
    p.add_common()
    return p


def _decode(args: argparse.Namespace, console: Console) -> int:
    kind = _output_kind(args)
    if args.output:
        common.check_output(args.output, args.overwrite)
    data = _input(args, console)
    from pd4dgs_codec.format.decoder import decode_partial

    start = time.perf_counter()
    scene, complete = decode_partial(
        data, max_layer=args.max_layer, max_bytes=args.max_bytes, allow_partial=args.allow_partial
    )
    seconds = time.perf_counter() - start
    console.detail(f"steps {scene.steps}")
    if kind == ".pt":
        common.write_checkpoint(args.output, scene, args.overwrite)
    elif kind == ".npz":
        common.write_bytes(args.output, _npz(scene, args.symbols), args.overwrite)
    if not complete:
        console.message(f"pd4dgs-decode: the input is cut; decoded the layers {list(scene.layers)}")
    result = _summary(scene, data, complete, seconds, args)
    console.result(result, _text(result), on_stdout=not args.output)
    return OK if complete else PARTIAL


main = common.command(parser, _decode)


def _input(args: argparse.Namespace, console: Console) -> bytes:
    """Reads the file; from a URL only the bytes that --max-layer and --max-bytes need."""
    from pd4dgs_codec.web import is_url

    if not is_url(args.input):
        return common.read_bytes(args.input)
    from pd4dgs_codec.web.client import Transfer, fetch

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
    """Returns ".npz", ".pt", or None without an output. Raises UsageError for options that do not fit."""
    kind = None if args.output is None else ".npz" if args.output == STDIO else Path(args.output).suffix
    if args.output == STDIO and args.json:
        raise UsageError("-o - and --json both write to stdout; name an output file")
    if kind not in (None, ".npz", ".pt"):
        raise UsageError(f"found -o {args.output}, expected a name that ends in .npz or .pt")
    if args.symbols and kind != ".npz":
        raise UsageError("--symbols needs -o FILE.npz")
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
        slices = described[layer]["slices"]
        ends = [part["end"] for part in slices]
        end = max(end for end in ends if end == ends[0] or args.max_bytes is None or end <= args.max_bytes)
        size = sum(part["bytes"] for part in slices if part["end"] <= end)
        anchors, active = total - (scene.rows[i - 1] if i else 0), int((scene.mask[i] > 0).sum())
        about = {"layer": layer, "offset": described[layer]["offset"], "bytes": size, "end": end}
        rows.append({**about, "anchors": anchors, "active": active})
    wanted = range(3 if args.max_layer is None else args.max_layer + 1)
    return {
        **{name: getattr(args, name) for name in ("input", "output", "max_layer", "max_bytes")},
        "bytes": len(data),
        "complete": complete,
        "seconds": round(seconds, 4),
        "anchors": len(scene.anchor_q),
        "global_deformation": scene.global_deformation is not None,
        "local_deformation": scene.local_deformation is not None,
        "layers": rows,
        "absent": [layer for layer in wanted if layer not in described],
    }


def _text(result: dict[str, Any]) -> str:
    layers = result["layers"]
    if not result["complete"]:
        state = "cut; valid so far"
    elif result["max_bytes"] is not None:
        state = f"valid in the first {layers[-1]['end']:,}"
    elif result["max_layer"] is not None:  # nothing is known about the bytes behind the prefix
        state = f"layers {', '.join(str(row['layer']) for row in layers)} whole and valid"
    else:
        state = "whole and valid"
    cells = [(row["layer"], *(number(row[k], 0) for k in ("bytes", "end", "anchors", "active"))) for row in layers]
    lines = [
        f"{shown_name(result['input'])}: {result['bytes']:,} bytes, {state}, decoded in {result['seconds']:.3f} s",
        table(("layer", "bytes", "prefix", "new anchors", "active"), cells),
        *(f"absent: layer {layer}; its level equals the one below" for layer in result["absent"]),
    ]
    if result["output"]:
        lines.append(f"wrote {shown_name(result['output'], 'stdout')}")
    return "\n".join(lines)
