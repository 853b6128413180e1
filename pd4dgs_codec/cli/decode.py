"""`pd4dgs-decode`: `.pd4` -> arrays, a checkpoint, or a check of every byte."""

from __future__ import annotations

import argparse
import io
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, PARTIAL, STDIO, Console, UsageError, number, say, shown_name, table

if TYPE_CHECKING:
    from pd4dgs_codec.kinds import AnyScene

DETAILS = """\
Without -o, pd4dgs-decode only checks the file and prints a summary.
A .npz output holds anchor, mask_L, meta_*, of a scaffold feature, scaling_log, offset, mlp.* and planes.*, and of
splats offset, color, opacity, scale, rotation, harmonics, window and tracks.*.
A .pt output is a checkpoint for encode, render and eval; splats have none.
From a URL (http, https), only the requested layers are fetched; interrupted transfers resume.
--max-layer is another name of --level.

examples:
  pd4dgs-decode scene.pd4
  pd4dgs-decode http://127.0.0.1:8000/scene.pd4 --level 1 -o prefix.npz
  pd4dgs-decode scene.pd4 --level 0 -o base.npz
  pd4dgs-decode scene.pd4 --max-bytes 100k -o early.npz
  head -c 300000 scene.pd4 | pd4dgs-decode - --allow-partial -o prefix.pt

exit code 3: truncated input, decoded as far as possible (--allow-partial)"""


def parser() -> options.Parser:
    p = options.Parser("decode", "[scene.pd4] [-o FILE]", "Decode a .pd4 file or its first layers.", DETAILS)
    p.add("input scene.pd4", ".pd4 file or URL; - reads stdin (default: -)", nargs="?", default=STDIO)
    p.add("-o, --output FILE", "FILE.npz or FILE.pt; - writes .npz to stdout (default: check only)")
    options.add_prefix(p.add, "decode")
    p.add("--symbols", "add quantised integers (NAME_q) and steps (NAME_step) to the .npz")
    p.add("--allow-partial", "decode the complete slices of a truncated file, with exit code 3")
    return p.add_common()


def _decode(args: argparse.Namespace, console: Console) -> int:
    kind = _output_kind(args)
    if args.output:
        common.check_output(args.output, args.overwrite)
    data, _ = common.read_prefix(args.input, console, args.level, args.max_bytes, args.allow_partial)
    from pd4dgs_codec.format.decoder import decode_partial
    from pd4dgs_codec.segments import base_beside

    start, base = time.perf_counter(), base_beside(args.input)
    scene, complete = decode_partial(
        data, max_layer=args.level, max_bytes=args.max_bytes, allow_partial=args.allow_partial, base=base
    )
    seconds = time.perf_counter() - start
    console.detail(f"steps {scene.all_steps}")
    if kind == ".pt":
        common.write_checkpoint(args.output, scene, args.overwrite)
    elif kind == ".npz":
        import numpy as np

        from pd4dgs_codec.format.info import to_npz_dict

        stream = io.BytesIO()
        np.savez(stream, **to_npz_dict(scene, args.symbols))  # type: ignore[arg-type]
        common.write_bytes(args.output, stream.getvalue(), args.overwrite)
    if not complete:
        say(f"pd4dgs-decode: warning: the input is truncated; decoded layers: {', '.join(map(str, scene.layers))}")
    result = _summary(scene, data, complete, seconds, args)
    console.result(result, _text(result), on_stdout=not args.output)
    return OK if complete else PARTIAL


main = common.command(parser, _decode)


def _output_kind(args: argparse.Namespace) -> str | None:
    """Returns ".npz", ".pt", or None without an output. Raises UsageError for options that do not fit."""
    kind = None if args.output is None else ".npz" if args.output == STDIO else Path(args.output).suffix
    if args.output == STDIO and args.json:
        raise UsageError("-o - and --json both write to stdout, expected -o FILE")
    if kind not in (None, ".npz", ".pt"):
        raise UsageError(f"found -o {args.output}, expected a name that ends in .npz or .pt")
    if args.symbols and kind != ".npz":
        raise UsageError("--symbols needs -o FILE.npz")
    return kind


def _summary(scene: AnyScene, data: bytes, complete: bool, seconds: float, args: argparse.Namespace) -> dict[str, Any]:
    from pd4dgs_codec.format.info import info

    described = {row["layer"]: row for row in info(data)["layers"]}
    rows, limit = [], min(len(data), args.max_bytes or len(data))
    for i, (layer, total) in enumerate(zip(scene.layers, scene.rows, strict=True)):
        slices = described[layer]["slices"]
        ends = [part["end"] for part in slices]
        end = max(end for end in ends if end == ends[0] or end <= limit)
        size = sum(part["bytes"] for part in slices if part["end"] <= end)
        anchors, active = total - (scene.rows[i - 1] if i else 0), int((scene.mask[i] > 0).sum())
        about = {"layer": layer, "offset": described[layer]["offset"], "bytes": size, "end": end}
        rows.append({**about, "anchors": anchors, "active": active})
    wanted = range(3 if args.level is None else args.level + 1)
    return {
        **{name: getattr(args, name) for name in ("input", "output", "level", "max_bytes")},
        "bytes": len(data),
        "complete": complete,
        "seconds": round(seconds, 4),
        "anchors": len(scene.anchor_q),
        "global_deformation": scene.deformation(1) is not None,
        "local_deformation": scene.deformation(2) is not None,
        "layers": rows,
        "absent": [layer for layer in wanted if layer not in described],
    }


def _text(result: dict[str, Any]) -> str:
    layers = result["layers"]
    if not result["complete"]:
        state = "truncated, valid so far"
    elif result["max_bytes"] is not None:
        state = f"first {layers[-1]['end']:,} bytes valid"
    elif result["level"] is not None:  # nothing is known about the bytes behind the prefix
        state = f"layers {', '.join(str(row['layer']) for row in layers)} valid"
    else:
        state = "complete and valid"
    cells = [(row["layer"], *(number(row[k], 0) for k in ("bytes", "end", "anchors", "active"))) for row in layers]
    lines = [
        f"{shown_name(result['input'])}: {result['bytes']:,} bytes, {state}, decoded in {result['seconds']:.3f} s",
        table(("layer", "bytes", "prefix", "new anchors", "active"), cells),
        *(f"no layer {layer}: level {layer} equals level {layer - 1}" for layer in result["absent"]),
    ]
    if result["output"]:
        lines.append(f"wrote {shown_name(result['output'], 'stdout')}")
    return "\n".join(lines)
