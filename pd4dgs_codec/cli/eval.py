"""`pd4dgs-eval`: quality and bytes per level."""

import argparse
from typing import Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, Console, number, progress_bar, say, table

DETAILS = f"""\
Decodes each level of a .pd4 file from its own prefix and compares its renderings with the held-out views.
mPSNR in dB and mSSIM follow the DyCheck protocol: 8-bit images, masked if the dataset has covisibility masks.
--protocol 3dgs reports the metrics of papers on Gaussian splatting, without masks: PSNR, SSIM as in the code of 3D
Gaussian Splatting, and LPIPS-VGG if the package lpips and its weights are installed.
For fixed test cameras, the moving region is measured too: pixels whose true colour changes by more than 16 of 255 over
time. --perceptual adds LPIPS, ST-LPIPS and FLIP, masked, as far as they are installed, and their temporal variants
(t-LPIPS, ...): the mean distance between successive frames of a fixed camera. See docs/evaluation.md.

{options.SOURCES}

examples:
  pd4dgs-eval scene.pd4 synthetic:local
  pd4dgs-eval scene.pd4 synthetic:local --perceptual
  pd4dgs-eval mutant.pd4 recordings/mutant --protocol 3dgs
  pd4dgs-eval model.pt recordings/kitchen --downscale 2 --json"""


def parser() -> options.Parser:
    p = options.Parser("eval", "FILE SOURCE", "Measure quality, bytes and time of each level on a dataset.", DETAILS)
    p.add("input FILE", ".pd4 file or .pt checkpoint; - reads a .pd4 from stdin")
    p.add("source SOURCE", "dataset to compare with, see below")
    options.add_prefix(p.add, "measure")
    options.add_reading(p.add)
    what = "metrics of DyCheck or of 3D Gaussian Splatting, see below (default: dycheck)"
    p.add("--protocol", what, choices=("dycheck", "3dgs"), default="dycheck")
    options.add_background(p.add, "the file's")
    p.add("--perceptual", "also measure perceptual distances (slow)")
    return p.add_common()


def _evaluate(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.quality.evaluate import evaluate
    from pd4dgs_codec.quality.levels import load_levels
    from pd4dgs_codec.quality.perceptual import PERCEPTUAL, VGG, load_perceptual

    file = common.named_input(args.input)
    levels = load_levels(file, args.level, max_bytes=args.max_bytes, background=args.background)
    dataset = common.read_dataset(args.source, args, levels[-1].model.info)
    console.detail(f"{args.source}: {len(dataset.train)} training views, {len(dataset.test)} held out")
    if not dataset.test:
        say("no held-out views: measuring on the training views")
    distances = (*(PERCEPTUAL if args.perceptual else ()), *([VGG] if args.protocol == "3dgs" else []))
    perceptual = load_perceptual(distances) if distances else None
    for name, why in (perceptual.absent if perceptual else {}).items():
        say(f"no {name}: {why}")
    with progress_bar(None, "images", "evaluating") as step:
        result = evaluate(levels, dataset, protocol=args.protocol, perceptual=perceptual, step=step)
    result = {"input": args.input, "downscale": args.downscale, "holdout": args.holdout, **result}
    console.result(result, _text(result), on_stdout=True)
    return OK


main = common.command(parser, _evaluate)


def _text(result: dict[str, Any]) -> str:
    from pd4dgs_codec.quality.evaluate import metric_columns

    columns = [
        *metric_columns(result),
        ("bytes so far", "cumulative_bytes", 0),
        ("anchors", "anchors", 0),
        ("decode s", "decode_seconds", 3),
        ("render ms", "render_ms", 1),
    ]
    head = ("level", *(title for title, _, _ in columns))
    rows = [(row["level"], *(number(row[key], digits) for _, key, digits in columns)) for row in result["levels"]]
    what = "held-out" if result["split"] == "test" else "training"
    masked = "covisibility masks" if result["masked"] else "no covisibility masks"
    masked = masked if result["protocol"] == "dycheck" else "protocol 3dgs"
    share = result["moving_share"]
    lines = [
        f"{result['source']}: {result['views']} {what} views, {result['width']}x{result['height']}, {masked}",
        table(head, rows),
        *([f"moving: pixels that change in views of fixed cameras ({100 * share:.1f} %)"] if share else []),
        *_distance_lines(result.get("perceptual")),
        f"baseline (mean training image): {number(result['baseline_mean_image_psnr'])} dB",
    ]
    return "\n".join(lines)


def _distance_lines(perceptual: dict[str, Any] | None) -> list[str]:
    if not perceptual or not perceptual["distances"]:
        return []
    sources = "; ".join(f"{d['title']}: {d['source']}" for d in perceptual["distances"].values())
    if "temporal_frames" not in perceptual:
        return [sources]
    camera, frames = perceptual["temporal_camera"], perceptual["temporal_frames"]
    return [sources, f"t-: between successive frames, {frames} from the camera of view {camera}"]
