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
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pd4dgs_codec.cli.common import number as number
from pd4dgs_codec.cli.common import say as say
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
    """A dataset and how it is trained. name: of its results, and its label in tables. what: it shows, for the page.
    iterations: training steps. protocol: of `pd4dgs-eval`; 3dgs for scenes that papers report on. training: further
    options of `pd4dgs-train`. usual: measured where --scenes names none."""

    name: str
    source: str
    what: str
    downscale: int = 1
    preset: str = "tiny"
    iterations: int = 1_500
    protocol: str = "dycheck"
    training: tuple[str, ...] = ()
    usual: bool = True

    @property
    def there(self) -> bool:
        """Whether its data are on this machine."""
        return self.source.startswith("synthetic:") or any(Path(self.source).glob("*.json"))

    @property
    def reading(self) -> list[str]:
        """SOURCE and the options that read it, as `pd4dgs-eval FILE` and `pd4dgs-train` take them."""
        return [self.source, "--downscale", str(self.downscale)]

    @property
    def data(self) -> list[str]:
        """The same as the option --data of other commands."""
        return ["--data", *self.reading]


MUTANT = str(OFFICIAL / "mutant")
#: Of scenes that take longer than all others together.
LARGE: dict[str, Any] = {"preset": "small", "iterations": 10_000, "protocol": "3dgs", "usual": False}
#: What reads the view direction in the paper; by default colours alone do.
ALL_VIEW = ("--view-dependent", "opacity+covariance+color")
JUMP = "path=jump&frames=200"
SCENES = {
    scene.name: scene
    for scene in (
        Scene("shelf-hand", str(SHARED / "shelf-hand"), "hand-held capture, 256 x 192", 2, "small", 5_000),
        # not D-NeRF's scene of this name
        Scene("orbit", str(SHARED / "bouncing-balls"), "renders of a 4D Gaussian model, 200 x 200", 4, "small", 3_000),
        Scene("static", "synthetic:static", "nothing moves, 160 x 120"),
        Scene("global", f"synthetic:global?{JUMP}", "large objects move, 160 x 120"),
        Scene("local", f"synthetic:local?{JUMP}", "large objects and small parts move, 160 x 120"),
        Scene("fast", f"synthetic:fast?{JUMP}", "quick motion, 160 x 120"),
        Scene("flyby", "synthetic:flyby", "a ball flies past a cube, on white, 100 x 100"),
        Scene("dart", "synthetic:dart", "a small ball flies fast, on white, 100 x 100"),
        Scene("rods", "synthetic:rods", "thin rods move, on white, 100 x 100"),
        Scene("dancer", "synthetic:dancer", "a figure dances with a lantern, on white, 200 x 200"),
        Scene("mutant-200", MUTANT, "D-NeRF, 200 x 200", 4, "small", 8_000, "3dgs"),
        Scene("mutant-400", MUTANT, "D-NeRF, 400 x 400", 2, training=ALL_VIEW, **LARGE),
        Scene("mutant", MUTANT, "D-NeRF, 800 x 800", **LARGE),
        Scene("mutant-black", MUTANT, "D-NeRF, 800 x 800, on black", training=("--background", "black"), **LARGE),
        Scene("basketball", str(OFFICIAL / "basketball"), "Panoptic Sports, 640 x 360", **LARGE),
    )
}
#: Where a second kind of scene says more, where it would say little, and where many trainings are compared.
TWO, ONE, TINY = ("shelf-hand", "mutant-200"), ("shelf-hand",), ("flyby",)
#: The scene of --quick.
QUICK = Scene("quick", "synthetic:local?size=48x36&frames=4", "a few pixels", iterations=10)


@dataclass(frozen=True)
class Training:
    """What Run.trained takes."""

    scene: Scene
    options: tuple[str, ...] = ()
    seed: int = 0
    longer: float = 1.0


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
        """(checkpoint, summary of `pd4dgs-train`) of a scene trained with `options`, `longer` times its steps, on one
        thread.

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
        train = command if self.quick else command_in_subprocess
        if kept.get("made_by") == made_by and path.is_file():
            result = train("train", scene.source, "-o", path, "--resume", path, "--log", log, "-j", 1)
        else:
            summary.write_text(json.dumps({"made_by": made_by, "finished": False}))
            path.unlink(missing_ok=True)  # of another package
            result = train("train", *asked, "-o", path, "--log", log, "-f", "-j", 1)
        summary.write_text(json.dumps(result | {"made_by": made_by}))
        if not result["finished"]:
            raise TrainError(f"{path}: training was interrupted; the same command resumes it")
        return path, result

    def train(self, jobs: Iterable[Training]) -> None:
        """Trains all of them, the longest first, one on each core: that uses cores better than the
        threads of one training."""
        order = sorted(dict.fromkeys(jobs), key=lambda job: -job.scene.iterations * job.longer)
        with ThreadPoolExecutor(1 if self.quick else os.cpu_count()) as pool:
            list(pool.map(lambda job: self.trained(job.scene, *job.options, seed=job.seed, longer=job.longer), order))

    def packed(self, scene: Scene, *options: str, name: str = "scene") -> Path:
        """The model of seed 0, packed with `options` into NAME.pd4."""
        path = self.folder(scene) / f"{name}.pd4"
        command("encode", self.trained(scene)[0], "-o", path, "-f", *options)
        return path


#: Code of the package, by what it is for, on which no rows depend unless a benchmark names it: other commands import it
#: only for URLs, if at all.
APART = {
    "delivery": (
        *("bench/latency.py", "cli/package.py", "cli/serve.py"),
        *(f"web/{name}.py" for name in ("client", "manifests", "package", "page", "server")),
    ),
    "batch": ("batch", "cli/batch.py"),
    "export": ("interchange/export.py", "cli/export.py"),
    "import": (
        *(f"interchange/{name}.py" for name in ("direct", "imported", "pack", "sampled", "scaffold_gs")),
        "cli/import_model.py",
    ),
    "prepare": ("prepare", "cli/prepare.py"),
    "view": ("cli/view.py",),
}


def package(*parts: str) -> tuple[str, ...]:
    """git pathspecs of the code of the package, and of what is APART in it only these parts."""
    left_out = [path for part, paths in APART.items() if part not in parts for path in paths]
    return ("pd4dgs_codec", *(f":!pd4dgs_codec/{path}" for path in left_out))


@dataclass(frozen=True)
class Benchmark:
    """scenes: names in SCENES; none where no scene is measured. measure: the rows of one scene (of None without
    scenes). text: the rows of all scenes as Markdown, without a heading. pictures: draws them into a folder and returns
    the file names. trainings: what it needs of a scene, so that they can run side by side before it measures. measured:
    git pathspecs of the code on which its rows depend."""

    name: str
    title: str
    scenes: tuple[str, ...]
    measure: Callable[[Run, Any], list[Row]]
    text: Callable[[Sequence[Row]], str]
    pictures: Callable[[Sequence[Row], Path], list[str]] = lambda rows, folder: []
    trainings: Callable[[Run, Any], list[Training]] = lambda run, scene: [Training(scene)]
    measured: tuple[str, ...] = package()


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


def command_in_subprocess(name: str, *arguments: object) -> Row:
    """The same in a process of its own. What it says on stderr is kept for its error alone."""
    words = [sys.executable, "-m", "pd4dgs_codec", name, *map(str, arguments), "--json"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        told = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise DataError(f"pd4dgs-{name} {' '.join(words[4:])}: exit code {done.returncode}: {told}")
    result: Row = json.loads(done.stdout)
    return result


def levels(scene: Scene, file: Path) -> list[Row]:
    """Held-out quality of each level of a file or a checkpoint: level, bytes, mpsnr, mssim, anchors, decode_seconds,
    render_ms, moving_mpsnr where test cameras stand still, and by the protocol 3dgs psnr, ssim and lpips_vgg."""
    keys = ("level", "mpsnr", "moving_mpsnr", "mssim", "psnr", "ssim", "lpips_vgg", "anchors", "decode_seconds")
    found = command("eval", file, *scene.reading, "--protocol", scene.protocol)["levels"]
    kept = (*keys, "render_ms")
    return [{"bytes": row["cumulative_bytes"]} | {key: row[key] for key in kept if key in row} for row in found]


def available(names: Sequence[str]) -> Iterator[Scene]:
    """The scenes of these names whose data are on this machine; the others are named on stderr."""
    for name in names:
        if SCENES[name].there:
            yield SCENES[name]
        else:
            say(f"{name}: {SCENES[name].source} does not exist, left out")


def save_jpeg(image: Any, path: Path, limit: int) -> None:
    """Saves an image of Pillow as JPEG: the best of some qualities that has at most `limit` bytes, else the least."""
    for quality in (95, 85, 75, 60):
        image.convert("RGB").save(path, quality=quality, subsampling=0)
        if path.stat().st_size <= limit:
            break


def peak_bytes(process: Path = Path("/proc/self")) -> int:
    """Peak bytes of a process, on Linux; getrusage also counts what it was forked from."""
    return 1024 * int((process / "status").read_text().split("VmHWM:")[1].split()[0])


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


@cache
def package_tree() -> str:
    """When it is first asked, what identifies the package's source: git's hash of it, and of what was changed since."""
    return git("rev-parse", "HEAD:pd4dgs_codec") + git("diff", "HEAD", "--shortstat", "--", "pd4dgs_codec")


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A Markdown table without padding."""
    lines = [head, ["-"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


def seconds_at(size: float, rate: float = LINK) -> str:
    """Seconds that so many bytes take on a link: 8 S / B."""
    return f"{8 * size / rate:.2f}"
