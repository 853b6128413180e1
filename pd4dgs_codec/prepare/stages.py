"""`prepare`: from a recording to a folder with pictures, times and a model of COLMAP, stage by stage.

The work is done in `FOLDER.partial`. It becomes FOLDER once all is there. A run that was cut leaves it, and the same
run goes on from it; one that cannot end takes it away.
"""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pd4dgs_codec.errors import DataError
from pd4dgs_codec.io import finite, write_bytes
from pd4dgs_codec.prepare import poses
from pd4dgs_codec.prepare.frames import FEWEST_FRAMES, Choice, Look, choose, look, open_recording, write_frames
from pd4dgs_codec.prepare.progress import Progress
from pd4dgs_codec.prepare.report import Findings, advice, draw, numbers

STATE, REPORT = "prepare.json", "report.json"


@dataclass(frozen=True)
class Choices:
    """What the caller chooses. frames: at most so many, 0 for all; fps: of a folder of frames; downscale: pictures are
    averaged over blocks of so many pixels a side; camera: COLMAP's model; threads: -1 for all cores."""

    frames: int = 120
    fps: float = 30.0
    downscale: int = 1
    camera: str = poses.CAMERA_MODELS[0]
    threads: int = -1


def prepare(
    source: Path, output: Path, choices: Choices, progress: Progress, overwrite: bool = False
) -> dict[str, Any]:
    """Writes the folder `output`; the numbers of its report. Raises DataError, one line, and leaves nothing behind,
    where no poses can be found."""
    poses.colmap()  # refuses now what the third stage would miss
    check_folder(output, overwrite)
    recording = open_recording(source, choices.fps)
    work = output.with_name(f"{output.name}.partial")
    _begin(work, source, choices)
    try:
        looks, choice, times = _frames(work, recording, choices, progress)
        findings = _poses(work, times, choices, progress)
        result = _finish(work, findings, looks, choice, times, source)
    except DataError:
        shutil.rmtree(work, ignore_errors=True)
        raise
    check_folder(output, overwrite)  # it may have appeared meanwhile
    if output.exists():
        shutil.rmtree(output)
    os.replace(work, output)
    return result


def check_folder(output: Path, overwrite: bool) -> None:
    """Refuses, before any work, an output that exists, unless it may be replaced and was made here."""
    if output.exists() and not (overwrite and (output / REPORT).is_file() and (output / "sparse").is_dir()):
        how = "expected a folder that pd4dgs-prepare made" if overwrite else "--overwrite replaces what was made here"
        raise DataError(f"{output}: exists already; {how}")
    if not output.resolve().parent.is_dir():
        raise DataError(f"{output}: there is no folder {output.parent} to write into")
    if not os.access(output.resolve().parent, os.W_OK):
        raise DataError(f"{output}: no permission to write here")


def _begin(work: Path, source: Path, choices: Choices) -> None:
    """Keeps what an earlier run of the same recording and choices left, else begins anew."""
    stat = source.stat()
    asked = {"source": str(source.resolve()), "size": stat.st_size, "changed": stat.st_mtime_ns}
    asked |= {name: value for name, value in asdict(choices).items() if name != "threads"}
    state = work / STATE
    if work.exists():
        if not state.is_file():
            raise DataError(f"{work}: exists already and is not of an earlier run, expected nothing there")
        try:
            if json.loads(state.read_text()) == asked:
                return
        except ValueError:
            pass
        shutil.rmtree(work)
    work.mkdir()
    write_bytes(state, json.dumps(asked).encode(), overwrite=True)


def _frames(
    work: Path, recording: Any, choices: Choices, progress: Progress
) -> tuple[list[Look], Choice, dict[str, float]]:
    """What is seen in the frames, which are taken, and their names with times; their pictures lie in images/."""
    done = work / "frames.json"
    if done.is_file():
        stored = json.loads(done.read_text())
        looks = [Look(i, t, sharp, float("inf") if i == 0 else change) for i, t, sharp, change in stored["looks"]]
        return looks, Choice(*map(tuple, stored["choice"])), stored["times"]
    with progress(None, "frames", "looking") as advance:
        looks = look(recording, advance)
    choice = choose(looks, choices.frames)
    if len(choice.chosen) < FEWEST_FRAMES:
        found = f"{len(choice.blurred)} blurred and {len(choice.repeated)} repeated of {len(looks)} frames"
        raise DataError(
            f"{recording.path}: {found} leave {len(choice.chosen)}, expected {FEWEST_FRAMES} that differ at least"
        )
    shutil.rmtree(work / "images", ignore_errors=True)
    (work / "images").mkdir()
    with progress(len(choice.chosen), "frames", "writing") as advance:
        times = write_frames(recording, choice.chosen, work / "images", choices.downscale, advance)
    content = {"looks": [list(asdict(each).values()) for each in looks], "times": times}
    content["choice"] = list(asdict(choice).values())
    write_bytes(done, json.dumps(finite(content)).encode(), overwrite=True)
    return looks, choice, times


def _poses(work: Path, times: dict[str, float], choices: Choices, progress: Progress) -> Findings:
    """The model, made a second time without what moves; it lies in sparse/0 then."""
    names, images, database = sorted(times), work / "images", work / "colmap.db"
    with progress(len(names), "frames", "features") as advance:
        poses.extract(database, images, names, choices.camera, choices.threads, advance)
    listed = poses.pairs(len(names))
    with progress(len(listed), "pairs", "matching") as advance:
        poses.match(database, names, listed, choices.threads, advance)
    still = work / "still.db"
    with progress(None, "frames", "poses") as advance:
        first = _checked(poses.reconstruct(database, images, work / "first", choices.threads, advance), len(names))
    verdicts = poses.moving_features(database, first)
    moving = {
        image.name: verdicts[image.name].moving(first.image(key).camera.width)
        for key, image in first.images.items()
        if image.name in verdicts
    }
    model = first
    if any(each.any() for each in moving.values()):
        shutil.copyfile(database, still)
        poses.leave_out(still, moving)
        with progress(None, "frames", "poses without what moves") as advance:
            second = poses.reconstruct(still, images, work / "second", choices.threads, advance)
        if second is not None and second.num_reg_images() >= first.num_reg_images():
            model = second
    poses.upright(model)
    target = work / "sparse" / "0"
    target.mkdir(parents=True, exist_ok=True)
    model.write(target)
    return Findings(model, verdicts, moving)


def _checked(model: Any | None, count: int) -> Any:
    """A model of enough of `count` frames."""
    found = 0 if model is None else model.num_reg_images()
    if model is None or found < max(FEWEST_FRAMES, poses.LEAST_SHARE * count):
        raise DataError(
            f"no camera poses: found those of {found} of {count} frames, expected half at least; record things "
            "that stand still and have texture, from a camera that moves slowly and sideways"
        )
    return model


def _finish(
    work: Path, findings: Findings, looks: list[Look], choice: Choice, times: dict[str, float], source: Path
) -> dict[str, Any]:
    """times.txt, the report with its picture; what was only for the way goes."""
    named = {image.name for image in findings.model.images.values() if image.has_pose}
    (work / "times.txt").write_text("".join(f"{name} {times[name]:.6f}\n" for name in sorted(named)))
    result = numbers(findings, looks, choice, times)
    result["source"] = source.name
    result["advice"] = advice(result)
    draw(findings, looks, choice, times, work / "images", work / "report.png")
    write_bytes(work / REPORT, json.dumps(finite(result), indent=1).encode(), overwrite=True)
    for name in sorted(set(times) - named):
        (work / "images" / name).unlink()
    for name in ("first", "second"):
        shutil.rmtree(work / name, ignore_errors=True)
    for name in ("colmap.db", "still.db", "frames.json", STATE):
        (work / name).unlink(missing_ok=True)
    return result
