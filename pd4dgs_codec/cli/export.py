"""`pd4dgs-export`: a `.pd4` file as explicit Gaussians that other viewers read."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli import common, options
from pd4dgs_codec.cli.common import OK, Console, UsageError, progress_bar, say
from pd4dgs_codec.errors import DataError, required
from pd4dgs_codec.io import check_path, whole_files

if TYPE_CHECKING:
    import numpy as np

    from pd4dgs_codec.data.view import View
    from pd4dgs_codec.draw.player import Drawer
    from pd4dgs_codec.interchange.export import Eyes
    from pd4dgs_codec.kinds.splats import Splats
    from pd4dgs_codec.scene import SceneInfo

DETAILS = f"""\
Splats are exported as they are, with harmonics of at most the degree of --sh. In a scene with networks, view-dependent
colours become spherical harmonics, and view-dependent opacities and sizes become means over many viewpoints. If only
colours are view-dependent (pd4dgs-info --json), only the harmonics are approximate. Viewpoints are the training cameras
of --data, or else lie around the point that the file's camera looks at. --compare measures the loss of quality.

  ply       one PLY file in the layout of 3D Gaussian Splatting
  ply-seq   a folder of such files, one per frame
  spz       one SPZ file (needs gaussforge)
  glb       one glTF file with KHR_gaussian_splatting
  4dgs      one .4dgs file of the whole time range (needs fourdgs)

PLY and 4dgs keep the axes of the file. For glTF and SPZ, the scene is rotated so that +y is up.

{options.SOURCES}

examples:
  pd4dgs-export scene.pd4 -o scene.ply --time 0.5
  pd4dgs-export scene.pd4 -o frames --to ply-seq --fps 10 --sh 1 --data recordings/kitchen
  pd4dgs-export scene.pd4 -o scene.glb --compare recordings/kitchen"""

SEQUENCES = ("ply-seq", "4dgs")
KINDS = ("ply", "ply-seq", "spz", "glb", "4dgs")
FILES = ".ply, .spz, .glb or .4dgs"
LIBRARIES = {"spz": "gaussforge", "4dgs": "fourdgs"}
FPS, MAX_FRAMES = 30.0, 100_000
SCALE = options.checked(float, lambda x: 1e-6 <= x <= 1e6, "a number from 1e-6 to 1e6")


def parser() -> options.Parser:
    p = options.Parser("export", "FILE -o OUT", "Export a scene as Gaussians for other viewers.", DETAILS)
    p.add("input FILE", ".pd4 file or a folder of segments; - reads stdin")
    p.add("-o, --output OUT", "output file; a folder for ply-seq", options.named, required=True)
    p.add("--to", "file format, see below (default: by the suffix of OUT)", choices=KINDS)
    p.add("--time T", "time of ply, spz and glb, as 0..1 of the file's time range (default: 0)", options.share)
    p.add("--fps F", f"frame rate of ply-seq and 4dgs (default: {FPS:g})", options.fps)
    options.add_level(p.add, "export")
    p.add("--sh", "degree of the spherical harmonics (default: 3)", int, choices=(0, 1, 2, 3), default=3)
    what = "factor on all lengths; enlarge small scenes for the fixed-point positions of SPZ (default: 1)"
    p.add("--scale X", what, SCALE, default=1.0)
    p.add("--data SOURCE", "use the training cameras of this dataset as viewpoints")
    p.add("--compare SOURCE", "measure PSNR before and after export on the held-out views of this dataset")
    options.add_reading(p.add, unset=options.READING)
    return p.add_common()


def _export(args: argparse.Namespace, console: Console) -> int:
    common.check_other_file(args.input, args.output)
    _check_usage(args)
    if args.to == "ply-seq":
        _check_folder(args.output, args.overwrite)
    else:
        common.check_output(args.output, args.overwrite)
    from pd4dgs_codec.interchange.export import cost
    from pd4dgs_codec.interchange.splats import EXTRA

    if args.to in LIBRARIES:
        required(LIBRARIES[args.to], EXTRA, f"{args.to} files")
    player = _player(args)
    views, eyes = _compared(args, player), _eyes(args, player)
    start = time.perf_counter()
    result = {"input": args.input, "output": args.output, "to": args.to, "level": player.level, "sh": args.sh}
    result |= (_write_sequence if args.to in SEQUENCES else _write_still)(args, player, eyes)
    result["seconds"] = time.perf_counter() - start
    if views:
        with progress_bar(len(views), "views", "comparing") as step:
            result["cost"] = cost(player, eyes, args.sh, views, step)
    console.result(result, _text(result))
    return OK


main = common.command(parser, _export)


def _check_usage(args: argparse.Namespace) -> None:
    suffix = Path(args.output).suffix.lower().removeprefix(".")
    if args.to is None:
        if suffix not in KINDS:
            raise UsageError(f"found -o {args.output}, expected a name that ends in {FILES}, or --to KIND")
        args.to = suffix
    if suffix in (*KINDS, "pt", "pd4") and suffix != args.to:
        raise UsageError(f"-o {args.output} ends in .{suffix}, but --to is {args.to}")
    options.conditional(args, args.to not in SEQUENCES, "needs --to ply, spz or glb", time=0.0)
    options.conditional(args, args.to in SEQUENCES, "needs --to ply-seq or 4dgs", fps=FPS)
    options.conditional(args, args.data or args.compare, "needs --data or --compare", **options.READING)


def _check_folder(path: str, overwrite: bool) -> None:
    """Raises DataError for a folder with frames of another run, which must not mix with the new ones."""
    check_path(path)
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{path}: is a file, expected a folder")
    if not overwrite and any(folder.glob("*.ply")):
        raise DataError(f"{path}: contains PLY files already; --overwrite removes them")


def _player(args: argparse.Namespace) -> Drawer:
    from pd4dgs_codec.draw.player import drawer
    from pd4dgs_codec.format.decoder import decode
    from pd4dgs_codec.quality.levels import Timeline
    from pd4dgs_codec.segments import base_beside, is_folder

    if is_folder(args.input):
        return Timeline(args.input, args.level)
    return drawer(decode(common.read_bytes(args.input), max_layer=args.level, base=base_beside(args.input)))


def _eyes(args: argparse.Namespace, player: Drawer) -> Eyes | None:
    """The viewpoints from which a scaffold is baked, None for splats, of which the degree of --sh is the highest."""
    from pd4dgs_codec.draw.player import Player
    from pd4dgs_codec.interchange.export import eyes_of_cameras, eyes_of_scene

    player, _ = player.at(0.0)
    if not isinstance(player, Player):
        if args.data is not None:
            raise UsageError(f"--data has no effect: {args.input} holds splats, which are exported as they are")
        return None
    if args.data is None:
        return eyes_of_scene(player)
    return eyes_of_cameras([view.camera for view in common.read_dataset(args.data, args, player.info).train])


def _compared(args: argparse.Namespace, player: Drawer) -> Sequence[View]:
    """The held-out views of --compare, empty without it. Raises DataError if it has none."""
    if args.compare is None:
        return ()
    views = common.read_dataset(args.compare, args, player.info).test
    if not views:
        raise DataError(f"{args.compare}: has no held-out views; expected another --holdout")
    return views


def _write_still(args: argparse.Namespace, player: Drawer, eyes: Eyes | None) -> dict[str, Any]:
    import numpy as np

    from pd4dgs_codec.interchange.export import UNTURNED, exported, upright
    from pd4dgs_codec.interchange.splats import SPZ_SCALE, SPZ_STEP, glb_bytes, ply_bytes, spz_bytes

    turn = upright(player.info.up) if args.to in ("glb", "spz") else UNTURNED
    splats, _ = exported(player, args.time, eyes, args.sh, turn)
    _check_some(len(splats.means), args)
    splats, sizes = splats.scaled(args.scale), args.scale * splats.scales.max(axis=1)
    if args.to == "spz" and (size := float(np.median(sizes))) < 4 * SPZ_STEP:
        what = f"half of the Gaussians are smaller than {size:.2g} units, and SPZ rounds positions to {SPZ_STEP:.2g}"
        say(f"pd4dgs-export: warning: {what}; --scale enlarges the scene")
    if args.to == "spz" and (count := np.count_nonzero(sizes > SPZ_SCALE)):
        what = f"{count:,} Gaussians are larger than {SPZ_SCALE:.0f} units, to which SPZ shrinks them"
        say(f"pd4dgs-export: warning: {what}; --scale below 1 keeps their size")
    data = {"ply": ply_bytes, "spz": spz_bytes, "glb": glb_bytes}[args.to](splats)
    common.write_bytes(args.output, data, args.overwrite)
    return {"frames": 1, "gaussians": len(splats.means), "bytes": len(data), "time": args.time}


def _check_some(count: int, args: argparse.Namespace) -> None:
    if not count:
        when = "any time" if args.to in SEQUENCES else "this time"
        raise DataError(f"{args.input}: has no visible Gaussians at this level and {when}, expected some")


def frame_times(info: SceneInfo, fps: float) -> list[float]:
    """Returns frame times in seconds from the scene's start, up to its end but for rounding. Raises DataError."""
    start, stop = info.time_range
    count = math.floor((stop - start) * fps * (1 + 1e-6)) + 1
    if count > MAX_FRAMES:
        raise DataError(
            f"{stop - start:g} seconds at {fps:g} frames per second are {count} frames, expected at most {MAX_FRAMES}"
        )
    return [i / fps for i in range(count)]


def _write_sequence(args: argparse.Namespace, player: Drawer, eyes: Eyes | None) -> dict[str, Any]:
    from pd4dgs_codec.interchange.export import exported
    from pd4dgs_codec.interchange.splats import fourdgs_bytes

    start, stop = player.info.time_range
    starts = frame_times(player.info, args.fps)

    def frames(step: Callable[[], None]) -> Iterator[tuple[float, Splats, np.ndarray]]:
        part: Drawer | None = None
        number = -1
        for seconds in starts:
            t = min(seconds / (stop - start), 1.0) if stop > start else 0.0
            before, part = part, player.at(t)[0]
            number += part is not before  # segments have slots of their own
            splats, slots = exported(player, t, eyes, args.sh)
            yield seconds, splats.scaled(args.scale), slots + (number << 40)
            step()

    with progress_bar(len(starts), "frames", "exporting") as step:
        if args.to == "ply-seq":
            return _write_folder(args, len(starts), (splats for _, splats, _ in frames(step)))
        kept = list(frames(step))
        _check_some(most := max(len(slots) for _, _, slots in kept), args)
        data = fourdgs_bytes(kept, starts[-1] + 1 / args.fps)
        common.write_bytes(args.output, data, args.overwrite)
        return {"frames": len(starts), "gaussians": most, "bytes": len(data)}


def _write_folder(args: argparse.Namespace, count: int, frames: Iterator[Splats]) -> dict[str, Any]:
    from pd4dgs_codec.interchange.splats import ply_bytes

    folder, most, total = Path(args.output), 0, 0
    names = [str(folder / f"{i:05d}.ply") for i in range(count)]
    with whole_files(names, args.overwrite) as temporaries:
        for temporary, splats in zip(temporaries, frames, strict=True):
            data = ply_bytes(splats)
            temporary.write_bytes(data)
            most, total = max(most, len(splats.means)), total + len(data)
        _check_some(most, args)
    for other in set(folder.glob("*.ply")) - {Path(name) for name in names}:
        other.unlink()
    return {"frames": count, "gaussians": most, "bytes": total}


def _text(result: dict[str, Any]) -> str:
    what = f"level {result['level']}, " + (f"{result['frames']} frames, " if result["to"] in SEQUENCES else "")
    text = f"{result['output']}: {what}{result['gaussians']:,} Gaussians, {result['bytes']:,} bytes"
    if "cost" in result:
        c = result["cost"]
        text += (
            f"\non {c['views']} held-out views: {c['direct_mpsnr']:.2f} dB rendered directly, "
            f"{c['exported_mpsnr']:.2f} dB exported; exported against direct {c['exported_to_direct_psnr']:.2f} dB"
        )
    return text
