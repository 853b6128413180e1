"""Scenes, trainings and the one interface of all benchmarks.

Benchmarks use the package as its users do: through the commands, whose options and JSON keys are stable.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pd4dgs_codec.errors import DataError, TrainError

ROOT = Path(__file__).resolve().parents[1]
#: The folder of the real scenes, which are not part of the repository.
SHARED = Path(os.environ.get("PD4DGS_SHARED") or ROOT.parent / "shared" / "data")
#: The folder of the scenes that papers report on, which name no licence: they are read in place.
OFFICIAL = Path(os.environ.get("PD4DGS_OFFICIAL") or ROOT.parent / "official")
#: The link rate of first-picture times, bits per second.
LINK = 2e6

#: One row of figures: "scene", and whatever the benchmark's table shows.
Row = dict[str, Any]


@dataclass(frozen=True)
class Scene:
    """A dataset and how it is trained. name: of its results, and its label in tables. iterations: training steps.
    protocol: of `pd4dgs-eval`; 3dgs for scenes that papers report on. training: further options of `pd4dgs-train`."""

    name: str
    source: str
    downscale: int = 1
    preset: str = "small"
    iterations: int = 1_500
    protocol: str = "dycheck"
    training: tuple[str, ...] = ()

    @property
    def there(self) -> bool:
        """Whether its data are on this machine."""
        return self.source.startswith("synthetic:") or Path(self.source).is_dir()

    @property
    def reading(self) -> list[str]:
        """SOURCE and the options that read it, as `pd4dgs-eval FILE` and `pd4dgs-train` take them."""
        return [self.source, "--downscale", str(self.downscale)]

    @property
    def data(self) -> list[str]:
        """The same as the option --data of other commands."""
        return ["--data", *self.reading]


SCENES = {
    scene.name: scene
    for scene in (
        Scene("shelf-hand", str(SHARED / "shelf-hand"), 2, iterations=5_000),
        # 160 renders of a trained 4D Gaussian model from one orbit: not D-NeRF's scene of this name
        Scene("orbit", str(SHARED / "bouncing-balls"), 4, iterations=7_000),
        *(Scene(f"synthetic-{name}", f"synthetic:{name}") for name in ("static", "global", "local", "fast")),
        Scene("mutant", str(OFFICIAL / "mutant"), 1, "small", 10_000, "3dgs"),
        Scene("mutant-black", str(OFFICIAL / "mutant"), 1, "small", 10_000, "3dgs", ("--background", "black")),
        Scene("basketball", str(OFFICIAL / "basketball"), 1, "small", 10_000, "3dgs"),
    )
}
REAL = ("shelf-hand", "orbit")
#: Where a second scene would say little more.
ONE = REAL[:1]
#: The scene of --quick.
QUICK = Scene("quick", "synthetic:local?size=48x36&frames=4", preset="tiny", iterations=10)


@dataclass(frozen=True)
class Run:
    """One call of run.py. out: trainings and files. images: where pictures go. seeds: trainings of a scene."""

    out: Path
    images: Path
    quick: bool = False
    seeds: int = 1

    def folder(self, scene: Scene) -> Path:
        """What belongs to a scene; made if it is not there."""
        folder = self.out / scene.name
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def trained(self, scene: Scene, *options: str, seed: int = 0, longer: float = 1.0) -> tuple[Path, Row]:
        """(checkpoint, summary of `pd4dgs-train`) of a scene trained with `options`, `longer` times its steps.

        A finished training of the same command and the same package is kept; an unfinished one is resumed.
        """
        steps = round(scene.iterations * longer)
        name = "-".join([f"{steps}", f"seed{seed}", *(option.strip("-") for option in options)])
        path = self.folder(scene) / f"{name}.pt"
        log, summary = path.with_suffix(".jsonl"), path.with_suffix(".json")
        asked = [*scene.reading, "--preset", scene.preset, "--iterations", str(steps), "--seed", str(seed)]
        asked += [*scene.training, *options]
        made_by = {"command": asked, "package": package_tree()}
        kept = json.loads(summary.read_text()) if summary.is_file() else {}
        if kept.get("made_by") == made_by and kept["finished"] and path.is_file():
            return path, kept
        say(f"training {path}")
        if kept.get("made_by") == made_by and path.is_file():
            result = command("train", scene.source, "-o", path, "--resume", path, "--log", log)
        else:
            summary.write_text(json.dumps({"made_by": made_by, "finished": False}))
            result = command("train", *asked, "-o", path, "--log", log, "-f")
        summary.write_text(json.dumps(result | {"made_by": made_by}))
        if not result["finished"]:
            raise TrainError(f"{path}: training was interrupted; the same command resumes it")
        return path, result

    def packed(self, scene: Scene, *options: str, name: str = "scene") -> Path:
        """The model of seed 0, packed with `options` into NAME.pd4."""
        path = self.folder(scene) / f"{name}.pd4"
        command("encode", self.trained(scene)[0], "-o", path, "-f", *options)
        return path


@dataclass(frozen=True)
class Benchmark:
    """scenes: names in SCENES; none where no scene is measured. measure: the rows of one scene (of None without
    scenes). text: the rows of all scenes as Markdown, without a heading. pictures: draws them into a folder and returns
    the file names."""

    name: str
    title: str
    scenes: tuple[str, ...]
    measure: Callable[[Run, Any], list[Row]]
    text: Callable[[Sequence[Row]], str]
    pictures: Callable[[Sequence[Row], Path], list[str]] = lambda rows, folder: []


def command(name: str, *arguments: object) -> Row:
    """The JSON that `pd4dgs-NAME ARGUMENTS --json` prints; it runs in this process. Raises DataError if it fails."""
    words = [*map(str, arguments), "--json"]
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        code = importlib.import_module(f"pd4dgs_codec.cli.{name}").main(words)
    if code:
        raise DataError(f"pd4dgs-{name} {' '.join(words)}: exit code {code}, expected 0")
    result: Row = json.loads(out.getvalue())
    return result


def levels(scene: Scene, file: Path) -> list[Row]:
    """Held-out quality of each level of a file or a checkpoint: level, bytes, mpsnr, mssim, anchors, decode_seconds,
    render_ms, moving_mpsnr where test cameras stand still, and by the protocol 3dgs psnr, ssim and lpips_vgg."""
    keys = ("level", "mpsnr", "moving_mpsnr", "mssim", "psnr", "ssim", "lpips_vgg", "anchors", "decode_seconds")
    found = command("eval", file, *scene.reading, "--protocol", scene.protocol)["levels"]
    kept = (*keys, "render_ms")
    return [{"bytes": row["cumulative_bytes"]} | {key: row[key] for key in kept if key in row} for row in found]


def present(names: Sequence[str]) -> Iterator[Scene]:
    """The scenes of these names whose data are on this machine; the others are named on stderr."""
    for name in names:
        if SCENES[name].there:
            yield SCENES[name]
        else:
            say(f"{name}: {SCENES[name].source} does not exist, left out")


def say(line: str) -> None:
    """Prints a stage as it begins."""
    print(line, file=sys.stderr, flush=True)


def git(*arguments: str) -> str:
    """What git prints about the repository; empty without git."""
    try:
        done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return ""
    return done.stdout.strip()


def commit() -> str:
    """The commit that is checked out, short, and whether the package was changed since; "unknown" without git."""
    name = git("rev-parse", "--short=7", "HEAD") or "unknown"
    return f"{name}, changed" if git("status", "--porcelain", "--", "pd4dgs_codec") else name


def package_tree() -> str:
    """What identifies the package's source: git's hash of it, and of what was changed since."""
    return git("rev-parse", "HEAD:pd4dgs_codec") + git("diff", "HEAD", "--shortstat", "--", "pd4dgs_codec")


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table without padding."""
    lines = [head, ["-"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def number(value: float | None, digits: int = 2) -> str:
    """A number with so many decimals and thousands separated, or a dash."""
    return "-" if value is None else f"{value:,.{digits}f}"


def seconds_at(size: float, rate: float = LINK) -> str:
    """Seconds that so many bytes take on a link: 8 S / B."""
    return f"{8 * size / rate:.2f}"
