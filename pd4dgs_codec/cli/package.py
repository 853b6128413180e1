"""`pd4dgs-package`: a `.pd4` file as a folder for any web server, with a page that plays it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pd4dgs_codec.cli import options
from pd4dgs_codec.cli.common import OK, STDIO, Console, command, number, progress_bar, read_bytes, same_file, say, table
from pd4dgs_codec.errors import DeliveryError, RenderError
from pd4dgs_codec.io import check_new, temporary_folder, write_files
from pd4dgs_codec.segments import is_folder

if TYPE_CHECKING:
    import numpy as np

    from pd4dgs_codec.kinds import AnyScene
    from pd4dgs_codec.web.manifests import Video
    from pd4dgs_codec.web.page import Still

T = TypeVar("T")

DETAILS = """\
DIR then holds scene.pd4 and index.html, a page that plays the scene from any static web server. For other players there
are index.json (byte ranges and SHA-256 of the slices), scene.mp4 with scene.mpd (DASH: each slice is a fragment in an
AdaptationSet of its own, which names the slice before it) and scene.m3u8 (HLS, with index.json as session data).

DASH clients can fetch the slices, but need a .pd4 decoder to show them. DASH and HLS players without one (dash.js,
Shaka Player, hls.js) show a 2D video, fallback.mp4, of the scene from its own camera. The video and the page's preview
image need numba (the extra [train]) and a file with a camera, the video ffmpeg as well; otherwise they are left out.
The preview image, at most 3 kB, is part of the page and is shown until the player has rendered a better one.

--immutable puts a checksum into the names of the files that others refer to, so that a CDN may cache them forever.
index.json lists the Cache-Control header of each file. For a folder of packages, pd4dgs-package writes library.json and
index.html beside them, with the poster, size and time to the first frame of each.

Of a folder of segments, DASH gets a period for each, which share the AdaptationSets of their base, and the HLS playlist
of the 2D video a discontinuity between two. The page fetches the current segment and the next one.

examples:
  pd4dgs-package scene.pd4 -o out/scene
  pd4dgs-package scene.pd4 -o out/scene --immutable
  pd4dgs-package out -o out
  pd4dgs-package scene.pd4 -o out/scene --no-video --json"""

MAX_FRAMES = 3000
SHOWN = 20  #: files that are listed
FRAGMENT_SECONDS = 2
#: The page's picture: pixels of the camera's longer side, how much wider and higher than the camera's picture it is,
#: and bytes, so that it arrives within 0.2 s at 200 kbps.
STILL_SIDE, STILL_REACH, STILL_BYTES = 160, 1.8, 3000
#: It is compared with what the player draws at the camera's size, of which the longer side has at most so many pixels.
COMPARED_SIDE = 480


def parser() -> options.Parser:
    summary = "Make a folder for web servers, with a player page, DASH and HLS."
    p = options.Parser("package", "scene.pd4 -o DIR", summary, DETAILS)
    p.add("input scene.pd4", ".pd4 file (- reads stdin), or a folder of segments or of packages")
    p.add("-o, --output DIR", "output folder, created if missing", options.named, required=True)
    p.add("--immutable", "put checksums into file names, for long-lived caches")
    p.add("--no-video", "make no 2D video")
    p.add("--fps F", "frame rate of the 2D video (default: 20)", options.fps)
    return p.add_common()


def check_usage(args: argparse.Namespace) -> None:
    """Sets conditional defaults of a package. Raises UsageError for options that do not fit together."""
    options.conditional(args, not args.no_video, "has no effect with --no-video", fps=20.0)


def _package(args: argparse.Namespace, console: Console) -> int:
    whole = args.input == STDIO or not is_folder(args.input)
    if whole and args.input != STDIO and Path(args.input).is_dir():
        return _library(args, console)
    check_usage(args)
    from pd4dgs_codec.web.package import INDEX, package, package_segments

    check_new([str(Path(args.output) / INDEX)], args.overwrite)  # before a video is rendered
    missing = {"2D video": "--no-video"} if args.no_video else {}

    def made(what: str, make: Callable[[], T]) -> T | None:
        """What `make` returns; None, and a remark, if something for it is missing."""
        try:
            return make()
        except RenderError as error:
            missing[what] = str(error)
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("pd4dgs_codec"):
                raise
            missing[what] = f"the module {error.name} is not installed"
        say(f"pd4dgs-package: no {what}: {missing[what]}")
        return None

    def render(scene: AnyScene, share: float) -> Video | None:
        return None if "2D video" in missing else made("2D video", lambda: _render(scene, share, args.fps))

    def draw(scene: AnyScene, prefixes: Iterator[tuple[int, AnyScene]]) -> Still | None:
        return made("preview image in the page", lambda: _still(scene, prefixes))

    if whole:
        contents: Iterable[tuple[str, bytes]] = package(
            read_bytes(args.input), render, draw, immutable=args.immutable
        ).items()
    elif same_file(args.input, args.output):
        raise DeliveryError(f"found -o {args.output}, the folder of the segments, expected another one")
    else:
        contents = package_segments(Path(args.input), render, draw, immutable=args.immutable)
    files = _write(args, contents)
    why = missing.get("2D video")
    result = {"input": args.input, "output": args.output, "files": files, "video": why is None}
    console.result(result | {"why_no_video": why}, _text(result))
    return OK


main = command(parser, _package)


def _library(args: argparse.Namespace, console: Console) -> int:
    from pd4dgs_codec.web.package import library

    options.conditional(args, False, "needs a .pd4 file, not a folder", immutable=False, no_video=False, fps=None)
    if not same_file(args.input, args.output):
        raise DeliveryError(f"found -o {args.output}, expected {args.input}, the folder of the packages")
    result = {"input": args.input, "output": args.output, "files": _write(args, library(Path(args.input)).items())}
    console.result(result, _text(result))
    return OK


def _write(args: argparse.Namespace, files: Iterable[tuple[str, bytes]]) -> list[dict[str, Any]]:
    sizes = write_files(args.output, files, args.overwrite)
    return [{"name": name, "bytes": size} for name, size in sizes.items()]


def _render(scene: AnyScene, share: float, fps: float) -> Video:
    """The video of a share of the scene's time, from its start on."""
    from PIL import Image

    from pd4dgs_codec.quality.frames import check_mp4, own_frames, write_mp4
    from pd4dgs_codec.quality.image import to_uint8
    from pd4dgs_codec.quality.levels import level_of
    from pd4dgs_codec.web.manifests import Video
    from pd4dgs_codec.web.package import presentation_seconds

    check_mp4()
    if scene.info.camera is None:
        raise RenderError("the file has no camera")
    count = max(2, round(share * presentation_seconds(*scene.info.time_range) * fps))
    if count > MAX_FRAMES:
        raise RenderError(f"found {count:,} frames, expected at most {MAX_FRAMES:,}; lower --fps")
    frames, level, poster = own_frames(scene.info, count), level_of(scene), BytesIO()
    camera = frames[0].camera
    with temporary_folder() as folder, progress_bar(len(frames), "frames", "video") as step:

        def pictures() -> Iterator[np.ndarray]:
            for i, frame in enumerate(frames):
                picture = to_uint8(level.picture(frame.camera, share * frame.time))
                if i == len(frames) // 2:
                    Image.fromarray(picture).save(poster, "jpeg", quality=85)
                yield picture
                step()

        path = folder / "video.mp4"
        write_mp4(pictures(), path, fps, fragment=max(1, round(FRAGMENT_SECONDS * fps)))
        size = camera.width // 2 * 2, camera.height // 2 * 2
        return Video(path.read_bytes(), *size, fps, poster.getvalue())


def _still(scene: AnyScene, prefixes: Iterator[tuple[int, AnyScene]]) -> Still:
    """The scene as the player shows it first, seen by its own camera, and what lies around that picture. Its worth: the
    bytes of the last prefix whose picture has fewer dB against the scene's than this one scaled up."""
    import numpy as np
    from PIL import Image

    from pd4dgs_codec.quality.image import mpsnr, to_uint8
    from pd4dgs_codec.quality.levels import level_of
    from pd4dgs_codec.web.page import Still

    camera = scene.info.camera
    if camera is None:
        raise RenderError("the file has no camera")

    def drawn(scene: AnyScene, side: int, reach: float = 1.0) -> np.ndarray:
        """Its picture at the start. side: pixels of the longer one of the camera's picture. reach: as in `Still`."""
        scale = side / max(camera.width, camera.height)
        width, height = (max(1, round(reach * scale * n)) for n in (camera.width, camera.height))
        K = camera.K * np.array([[scale], [scale], [1]], np.float32)
        K[:2, 2] += (width - scale * camera.width) / 2, (height - scale * camera.height) / 2
        return level_of(scene).picture(replace(camera, K=K, width=width, height=height), 0.0)

    picture = to_uint8(drawn(scene, STILL_SIDE, STILL_REACH))
    for quality in (70, 50, 30, 10, 0):
        file = BytesIO()
        Image.fromarray(picture).save(file, "webp", quality=quality, method=6)
        if file.tell() <= STILL_BYTES:
            break
    side = min(COMPARED_SIDE, max(camera.width, camera.height))
    whole = drawn(scene, side)
    blurred = Image.open(file).convert("RGB")
    inset = (1 - 1 / STILL_REACH) / 2
    box = (inset * blurred.width, inset * blurred.height, (1 - inset) * blurred.width, (1 - inset) * blurred.height)
    shown = np.asarray(blurred.resize(whole.shape[1::-1], Image.Resampling.BILINEAR, box))
    least = mpsnr(shown, to_uint8(whole))
    worth = max((size for size, prefix in prefixes if mpsnr(drawn(prefix, side), whole) < least), default=0)
    red, green, blue = to_uint8(np.array(scene.background()))
    return Still(file.getvalue(), STILL_REACH, camera.width / camera.height, f"rgb({red},{green},{blue})", worth)


def _text(result: dict[str, Any]) -> str:
    rows = [(row["name"], number(row["bytes"], 0)) for row in result["files"]]
    more = f"\nand {len(rows) - SHOWN:,} before them" if len(rows) > SHOWN else ""
    return f"{result['output']}: {len(rows)} files\n{table(('file', 'bytes'), rows[-SHOWN:])}{more}"
