"""Trains a capture as a folder of segments for `pd4dgs-train`: first the whole, then segments, some at a time."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.cli.common import TrainingProgress, number, say
from pd4dgs_codec.errors import DataError, DecodeError, Pd4Error, TrainError
from pd4dgs_codec.io import check_path, remove_temporaries, write_bytes
from pd4dgs_codec.segments import INDEX, File, Index, Segment, file_of, parse
from pd4dgs_codec.signals import follow_parent, stop_request
from pd4dgs_codec.threads import available, configure

if TYPE_CHECKING:
    from pd4dgs_codec.data.view import Dataset
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.segmented import Cuts

#: The trained whole, which segments start from and players do not need, and its layer 0.
WHOLE, BASE = "whole.pd4", "base-0000.pd4"
POLL_SECONDS = 0.5  #: between looks at signals while segments train in other processes


@dataclass(frozen=True)
class Capture:
    """What is trained, and how. reading: options of `load_source`. length, overlap: seconds of segments. threads: of
    all parts together, None for all cores."""

    config: TrainConfig
    reading: dict[str, Any]
    length: float
    overlap: float
    device: str
    threads: int | None

    def read(self) -> tuple[Dataset, Cuts]:
        """Reads the capture without its pixels, and cuts it."""
        from pd4dgs_codec.data.view import pixels_later
        from pd4dgs_codec.interchange.teacher import load_source
        from pd4dgs_codec.train.segmented import cuts_of

        with pixels_later():
            dataset = load_source(self.config.source, **self.reading)
        return dataset, cuts_of(dataset, self.length, self.overlap)

    def made(self, cuts: Cuts) -> dict[str, Any]:
        """What the index remembers, so that another training is not continued."""
        about = {"source": self.config.source, "overlap": self.overlap, "segments": len(cuts.ranges)}
        return about | {"config": json.loads(self.config.to_json()), "reading": json.loads(json.dumps(self.reading))}


def name_of(k: int) -> str:
    return f"{k:05d}.pd4"


def train_one(
    capture: Capture, k: int | None, output: Path, whole: Path | None, *, told: bool = True
) -> dict[str, Any]:
    """Trains segment `k`, or the whole for None, into a file. told: whether steps are shown. Returns numbers as
    `train_part`. Raises DataError and TrainError."""
    from pd4dgs_codec.train.segmented import Part, train_part

    dataset, cuts = capture.read()
    if k is None:
        part = Part(capture.config, output, device=capture.device)
        say(f"the model of all times, {cuts.whole_views} views")
    elif k >= len(cuts.ranges):
        raise DataError(f"found segment {k}, expected 0 to {len(cuts.ranges) - 1}")
    else:
        start, stop = cuts.ranges[k]
        part = Part(capture.config, output, (start, stop), whole, capture.device)
        say(f"segment {k}, {start:.4g} to {stop:.4g} s, {cuts.views[k]} views")
    result = train_part(part, dataset, TrainingProgress() if told else None)
    what = "the model of all times" if k is None else f"segment {k}"
    levels = ", ".join(map(number, result["psnr"]))
    say(f"{what}: {result['iterations']} steps, {result['anchors']:,} anchors, {levels} dB")
    return result


def manifest(capture: Capture) -> bytes:
    """The lines of a manifest for pd4dgs-batch, of the whole and of segments that need it."""
    from pd4dgs_codec.train.config import OPTIONS, TrainConfig

    _, cuts = capture.read()
    usual, named = TrainConfig(), capture.config
    options: dict[str, Any] = {"segments": capture.length, "overlap": capture.overlap}
    for name, about in OPTIONS.items():
        value = getattr(named, name)
        if (about.help or name in capture.reading) and value != getattr(usual, name):
            text = ",".join(map(str, value)) if isinstance(value, tuple) else value
            options[name.replace("_", "-")] = text
    common = {"source": named.source}
    lines: list[dict[str, Any]] = [common | {"output": WHOLE, "options": options | {"part": "whole"}}]
    for k in range(len(cuts.ranges)):
        lines.append(common | {"output": name_of(k), "options": options | {"part": k}, "needs": {"whole": WHOLE}})
    return "".join(json.dumps(line) + "\n" for line in lines).encode()


def train_folder(capture: Capture, output: str, overwrite: bool) -> dict[str, Any]:
    """Trains all parts that the folder lacks, and writes its index after each. Returns the numbers of the command.
    Raises DataError and TrainError, also for a folder of another training without `overwrite`."""
    from pd4dgs_codec.train.segmented import SHARE, base_of

    check_path(output)
    dataset, cuts = capture.read()
    folder, ranges = Path(output), cuts.ranges
    if folder.exists() and not folder.is_dir():
        raise DataError(f"{folder}: is a file, expected a folder to write segments into")
    made = capture.made(cuts)
    _check_folder(folder, made, overwrite, [WHOLE, BASE, *map(name_of, range(len(ranges)))])
    shown = ", ".join(map(str, cuts.views[:12])) + ", ..." * (len(ranges) > 12)
    start, stop = dataset.time_range
    say(f"{len(ranges)} segments from {start:.4g} to {stop:.4g} s, with {shown} training views of them; "
        f"{cuts.whole_views} for the model of all times, which trains for the given steps and time limit; each segment "
        f"trains for 1/{1 / SHARE:.0f} of them")  # fmt: skip
    for remark in dataset.remarks():
        say(f"note: {remark}")
    del dataset
    folder.mkdir(parents=True, exist_ok=True)
    whole, trained, interrupted = folder / WHOLE, 0, False
    if not whole.exists():
        interrupted = train_one(capture, None, whole, None)["interrupted"]
    index, before = Index((), (), made), 0
    if whole.exists():
        write_bytes(folder / BASE, base_of(whole.read_bytes()), overwrite=True)
        index = _grown(folder, index, cuts)
        lacking = [k for k in range(len(ranges)) if _segment(folder, k, cuts, index.bases[0]) is None]
        before = len(ranges) - len(lacking)
        if other := [name for name in map(name_of, lacking) if (folder / name).exists()]:
            raise DataError(f"{folder / other[0]}: is of another base or other times; remove it to train it again")
        for _ in () if interrupted else _trained(capture, folder, lacking):
            trained += 1
            index = _grown(folder, index, cuts)
    finished = len(index.segments) == len(ranges)
    sizes = [sum(file.bytes for file in files) for files in (index.bases, index.segments)]
    return {
        "output": output,
        "source": capture.config.source,
        "segments": len(ranges),
        "kept": before,
        "trained": trained,
        "finished": finished,
        "interrupted": not finished,
        "bytes": sum(sizes),
        "base_bytes": sizes[0],
    }


def _check_folder(folder: Path, made: dict[str, Any], overwrite: bool, names: list[str]) -> None:
    """Raises DataError for a folder of another training; with `overwrite`, removes what it holds of it."""
    place = folder / INDEX
    if overwrite:
        for name in [INDEX, *names, *(str(Path(name).with_suffix(".pt")) for name in names)]:
            (folder / name).unlink(missing_ok=True)
    elif place.exists() and parse(place.read_bytes(), str(place)).made != made:
        raise DataError(f"{folder}: holds another training; --overwrite replaces it")


def _grown(folder: Path, index: Index, cuts: Cuts) -> Index:
    """Writes the index with the base and the segments that follow its last one and are there, and returns it."""
    bases = index.bases or (file_of(BASE, (folder / BASE).read_bytes()),)
    segments = list(index.segments)
    while len(segments) < len(cuts.ranges) and (more := _segment(folder, len(segments), cuts, bases[0])):
        segments.append(more)
    index = Index(bases, tuple(segments), index.made)
    write_bytes(folder / INDEX, index.packed(), overwrite=True)
    return index


def _segment(folder: Path, k: int, cuts: Cuts, base: File) -> Segment | None:
    """The row of a segment in the index; None if its file is not there, or of other times or of another base."""
    import numpy as np

    from pd4dgs_codec.format.info import info
    from pd4dgs_codec.format.reader import read_base

    path = folder / name_of(k)
    if not path.exists():
        return None
    data = path.read_bytes()
    with contextlib.suppress(DecodeError):
        about, reference = info(data), read_base((folder / base.file).read_bytes()).reference
        times = [float(np.float32(t)) for t in cuts.ranges[k]]
        if about["time_range"] == times and (about["base"] or {}).get("digest") == reference.digest.hex():
            return Segment(**vars(file_of(path.name, data)), time_range=(times[0], times[1]), base=0)
    return None


# -- several at a time -------------------------------------------------------------------------------------------------


def _trained(capture: Capture, folder: Path, lacking: list[int]) -> Iterator[int]:
    """Trains segments and yields each whose file is written. After a signal it starts no more, and those that train
    stop with a checkpoint. Raises TrainError, behind all others, if one failed."""
    cores = capture.threads or available()
    workers = min(cores, len(lacking))
    if workers < 2:
        for k in lacking:
            if not train_one(capture, k, folder / name_of(k), folder / WHOLE)["finished"]:
                return
            yield k
        return
    context, waiting, failed = multiprocessing.get_context("spawn"), list(lacking), list[int]()
    running, told = dict[int, tuple[int, Any]](), False
    with stop_request() as stop:
        try:
            while running or (waiting and not stop.is_set()):
                while waiting and len(running) < workers and not stop.is_set():
                    k = waiting.pop(0)
                    child = context.Process(target=_child, args=(capture, k, folder, cores // workers))
                    child.start()
                    running[child.sentinel] = k, child
                ended = wait(list(running), POLL_SECONDS)
                if stop.is_set() and not told:
                    told = True
                    for _, child in running.values():
                        child.terminate()
                for k, child in (running.pop(sentinel) for sentinel in ended):  # type: ignore[arg-type]
                    child.join()
                    if (folder / name_of(k)).exists():
                        yield k
                    elif not stop.is_set():
                        failed.append(k)
        finally:
            for _, child in running.values():
                child.kill()
    if failed:
        raise TrainError(f"{folder}: segments {', '.join(map(str, failed))} failed; the same command tries them again")


def _child(capture: Capture, k: int, folder: Path, threads: int) -> None:
    """Trains a segment in a process of its own."""
    follow_parent(remove_temporaries)
    configure(threads)
    try:
        train_one(capture, k, folder / name_of(k), folder / WHOLE, told=False)
    except Pd4Error as error:
        say(f"segment {k}: {error}")
        sys.exit(1)
