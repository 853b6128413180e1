"""`pd4dgs-info`: what a `.pd4` file holds."""

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import OK, Console, color, command, number, read_prefix, shown_name, table

DETAILS = """\
The time to the first frame is 8 * (bytes to the end of the first slice) / rate, without latency.
From a URL (http, https), only the header is fetched, unless --check, --bytes or --hashes needs the whole file.
Of a folder of segments the files are listed; --check reads and decodes all of them.

examples:
  pd4dgs-info scene.pd4
  pd4dgs-info --sample --bytes
  pd4dgs-info scene.pd4 --check --at 500k,2M,50M --json
  pd4dgs-info http://127.0.0.1:8000/scene.pd4"""

#: Shown per layer with -v: quantisation steps; planes as [channels, x, y, z, t], widths of the networks' layers and the
#: normalised time of a key instant, or the numbers of instants, of bases by head and of groups; of an unknown kind the
#: tensors of `Tables.json`.
DETAIL_KEYS = ("steps", "planes", "networks", "key_instant", "instants", "heads", "groups", "kind", "grid_step",
               "grids", "chain_step", "chains")  # fmt: skip

SHOWN = 12  #: segments that are listed


def parser() -> options.Parser:
    p = options.Parser("info", "FILE", "Show the header and layers of a .pd4 file.", DETAILS)
    options.add_file(p.add, "FILE", ".pd4 file or URL, or a folder of segments; - reads stdin")
    p.add("--check", "decode the whole file and check every checksum and rule")
    p.add("--bytes", "show the bytes of each part of each layer")
    p.add("--hashes", "show SHA-256 of the integers and float32 tensors of each layer")
    what = "link rates in bits per second for the time to the first frame (default: 2M,10M,50M)"
    p.add("--at RATES", what, options.rates, default="2M,10M,50M")
    return p.add_common()


def _info(args: argparse.Namespace, console: Console) -> int:
    options.choose_file(args, "FILE")
    from pd4dgs_codec.segments import base_beside, is_folder

    if is_folder(args.input):
        options.conditional(args, False, "needs a .pd4 file, not a folder", bytes=False, hashes=False)
        return _segments(args, console)
    whole = args.check or args.bytes or args.hashes
    data, total = read_prefix(args.input, console, max_bytes=None if whole else 0)
    from pd4dgs_codec.format.info import hashes, info
    from pd4dgs_codec.format.reader import read_layers

    result = {"input": args.input, **info(data), "available": total}
    end = result["layers"][0]["slices"][0]["end"]
    result["first_frame_seconds"] = {name: 8 * end / rate for name, rate in args.at.items()}
    result["left_out"] = [] if "degree" in result else _left_out(result["layers"])  # splats have the layers they need
    if args.bytes or args.check:
        base = base_beside(args.input)
        _, layers = read_layers(data, base=base)
    if args.bytes:
        result["parts"] = _parts(result, [layer.bits for layer in layers])
    if args.check:
        result["checked"] = True
    if args.hashes:
        result["hashes"] = hashes(data, base=base_beside(args.input))
    for row in result["layers"]:
        found = [f"{key} {row[key]}" for key in DETAIL_KEYS if key in row]
        console.detail(f"layer {row['layer']}: {', '.join(found) or 'incomplete'}")
    console.result(result, _text(result), on_stdout=True)
    return OK


main = command(parser, _info)


def _segments(args: argparse.Namespace, console: Console) -> int:
    """Lists a folder of segments; with --check, reads all of them."""
    from pd4dgs_codec.segments import read_index

    folder, index = read_index(args.input)
    low, high = index.time_range
    sizes = [sum(file.bytes for file in files) for files in (index.bases, index.segments)]
    result = {"input": args.input, **index.json(), "time_range": [low, high], "bytes": sum(sizes)}
    if args.check:
        from pd4dgs_codec.quality.levels import Timeline

        timeline = Timeline(folder)
        for segment in index.segments:
            timeline.at((segment.time_range[0] - low) / (high - low))
        result["checked"] = True
    first = index.bases[index.segments[0].base].bytes if index.segments[0].base is not None else 0
    result["first_frame_seconds"] = {
        name: 8 * (first or index.segments[0].bytes) / rate for name, rate in args.at.items()
    }
    head = f"{args.input}: {len(index.segments):,} segments, {low:g} to {high:g} s, {sum(sizes):,} bytes: "
    lines = [head + f"{sizes[0]:,} of what segments share, {sizes[1] / (high - low):,.0f} a second"]
    rows = []
    for s in index.segments:
        base = "-" if s.base is None else index.bases[s.base].file
        rows.append((s.file, *(f"{t:.6g}" for t in s.time_range), base, number(s.bytes, 0)))
    lines.append(table(("segment", "from s", "to s", "base", "bytes"), rows if console.verbose else rows[:SHOWN]))
    lines += [f"and {len(rows) - SHOWN:,} more (-v lists all)"] if len(rows) > SHOWN and not console.verbose else []
    lines += ["checked: every segment decodes"] if args.check else []
    console.result(result, "\n".join(lines), on_stdout=True)
    return OK


def _parts(result: dict[str, Any], bits: Sequence[Mapping[str, int]]) -> list[dict[str, Any]]:
    """Returns the bytes of each group of channels by layer, and of all other parts. The header counts as part of layer
    0; other chunks belong to no layer. bits: by group, of each layer."""
    layers = result["layers"]
    parts: list[dict[str, Any]]
    parts = [{"part": name, "layers": [round(own[name] / 8) for own in bits]} for name in bits[0]]
    frames = [row["bytes"] - sum(part["layers"][i] for part in parts) for i, row in enumerate(layers)]
    frames[0] += result["header_bytes"]
    parts.append({"part": "header, frames, parameters", "layers": frames})
    for row in parts:
        row["bytes"] = sum(row["layers"])
    other = sum(chunk["bytes"] for chunk in result["chunks"])
    if other:
        parts.append({"part": "other chunks", "layers": [0] * len(layers), "bytes": other})
    return parts


def _parts_table(result: dict[str, Any]) -> str:
    heads = ("part", *(f"layer {row['layer']}" for row in result["layers"]), "all", "share")
    rows = []
    for row in result["parts"]:
        sizes = [number(size, 0) for size in (*row["layers"], row["bytes"])]
        rows.append((row["part"], *sizes, f"{100 * row['bytes'] / result['bytes']:.1f} %"))
    return table(heads, rows)


def _left_out(layers: list[dict[str, Any]]) -> list[dict[str, str]]:
    """Lists layers, deformations and residual heads of known kinds that this file does not have."""
    from pd4dgs_codec.scene import HEADS

    why = "without visible effect, or above --layers"
    rows = {row["layer"]: row for row in layers}
    missing = []
    for layer in (1, 2):
        row, name = rows.get(layer), f"hexplane of layer {layer}"
        if row is None:
            missing.append(f"layer {layer}")
        elif "networks" in row:  # known only if the whole chunk is present
            gone = [f"{name} head {head}" for head in HEADS if head not in row["networks"]]
            missing += [name] if len(gone) == len(HEADS) else gone
    return [{"what": what, "why": why} for what in missing]


def _about_lines(metadata: dict[str, Any] | None) -> list[str]:
    if metadata is None:
        return []
    texts = [f"{name}: {value}" for name, value in metadata.items() if isinstance(value, str) and name != "fault"]
    quality = ", ".join(f"level {level} {db:.2f} dB" for level, db in metadata.get("quality", {}).items())
    lines = [*texts, *([f"quality on held-out views: {quality}"] if quality else [])]
    if "still_bytes" in metadata:
        lines.append(f"preview image: {metadata['still_bytes']:,} bytes")
    return [*lines, *([f"metadata cannot be read: {metadata['fault']}"] if "fault" in metadata else [])]


def _slice_lines(result: dict[str, Any]) -> list[str]:
    """Lists the ends of the slices if a layer has several, and the quality after each if the file states it."""
    parts = [(row["layer"], part) for row in result["layers"] for part in row["slices"]]
    if len(parts) == len(result["layers"]):
        return []
    quality = (result["metadata"] or {}).get("slices", [])
    shown = quality if len(quality) == len(parts) else [None] * len(parts)
    rows = [
        (i, layer, number(part["end"], 0), number(part.get("anchors"), 0), color(part.get("fill")), number(db, 2))
        for i, ((layer, part), db) in enumerate(zip(parts, shown, strict=True))
    ]
    return [table(("slice", "layer", "prefix", "new anchors", "fill", "mPSNR dB"), rows)]


def _text(result: dict[str, Any]) -> str:
    rest = result["available"] - result["bytes"]
    cut = f", truncated to {result['available']:,}" if rest < 0 else f", {rest:,} more behind its end" if rest else ""
    low, high = result["time_range"]
    what = f"splats with harmonics of degree {result['degree']}" if "degree" in result else "anchors"
    left_out, base = result["left_out"], result["base"]
    lines = [
        f"{shown_name(result['input'])}: .pd4 format {result['format_version']}, {result['bytes']:,} bytes{cut}",
        f"mode {result['mode']}, header {result['header_bytes']} bytes, "
        f"{number(result['anchors'], 0)} {what} on a grid of {result['voxel_size']:.6g} scene units, "
        f"time {low:g} to {high:g} s",
        table(
            ("layer", "offset", "bytes", "prefix", "new anchors"),
            [
                (row["layer"], *(number(row.get(key), 0) for key in ("offset", "bytes", "end", "anchors")))
                for row in result["layers"]
            ],
        ),
        *([f"adds to the {base['rows']:,} rows of layer 0 of scene {base['scene']}, its base"] if base else []),
        *_slice_lines(result),
        *_about_lines(result["metadata"]),
        *([f"left out: {', '.join(row['what'] for row in left_out)} ({left_out[0]['why']})"] if left_out else []),
        "first frame: " + ", ".join(f"{s:.2f} s at {rate}bps" for rate, s in result["first_frame_seconds"].items()),
    ]
    if "parts" in result:
        lines.append(_parts_table(result))
    if result.get("checked"):
        lines.append("checked: every layer decodes")
    for row in result.get("hashes", []):
        lines.append(f"layer {row['layer']}: symbols {row['symbols']}")
        lines.append(f"layer {row['layer']}: tensors {row['tensors']}")
    return "\n".join(lines)
