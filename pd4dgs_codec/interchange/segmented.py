"""Packs a long sequence of explicit Gaussians as a folder of segments, see `segments`, in memory that is constant.

A first pass over the frames finds the Gaussians that stand still over all segments of a group, which go into a base,
once. Then each segment is packed by itself: what it does not share with the base, and its motion. Neighbours sample the
same frame at their seam. A new group begins where a base of all segments would save less than one of their own costs.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pd4dgs_codec.data.view import seconds_range
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode_with_report, with_metadata
from pd4dgs_codec.format.info import info as about
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.reader import Base, read_base
from pd4dgs_codec.format.registry import MAX_SIDE
from pd4dgs_codec.interchange.direct import CHECKED, Packer, Seen, Views, canonical, mean_psnr
from pd4dgs_codec.interchange.imported import BOX_INSTANTS, FPS, Progress, scene_info, seen_by
from pd4dgs_codec.interchange.pack import Grid, Ordered, Packed, Pictures, Tensors, cells_of, matched, sensitivity
from pd4dgs_codec.interchange.sampled import (
    MOVES,
    Sampled,
    features,
    in_order,
    matched_frames,
    mutual,
    reach_of,
    stacked,
)
from pd4dgs_codec.interchange.splats import evenly
from pd4dgs_codec.interchange.teacher import Teacher, read_model, spread
from pd4dgs_codec.interchange.tracks import Grouping
from pd4dgs_codec.io import check_path, write_bytes
from pd4dgs_codec.kinds.splats import Splats, SplatScene
from pd4dgs_codec.kinds.tracks import Tracks, place
from pd4dgs_codec.scene import Camera, Grading, SceneInfo
from pd4dgs_codec.segments import INDEX, File, Index, Segment, check, file_of, parse
from pd4dgs_codec.threads import one_blas_thread

#: The steps of a segment's coefficients are finer by this: their error is largest at its ends, where neighbours meet.
#: 2 dB at seams for 1 % of the bytes.
SEAM = 0.5
#: Of windows: those of Gaussians that are always shown (centre, half width, softness), and the least share of a frame
#: that they have to be precise to.
ALWAYS, PRECISE = (0.5, 1.0, 1.0), 0.05


class Unordered(Exception):
    """Frames do not keep their rows."""


class Frames(Sequence[Any]):
    """The frames of a model, read when they are asked for, all with as many harmonics. rows: the number of Gaussians
    in each, else Unordered is raised; None: any. digests: SHA-256 of those that were read, by number."""

    def __init__(self, model: Teacher, times: Sequence[float]):
        self.model, self.times = model, times
        self.digests = dict[int, bytes]()
        first = model.splats(float(times[0]))
        self.harmonics = first.sh.shape[1]
        self.rows: int | None = len(first.means)

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, i: Any) -> Any:
        frame = self.model.splats(float(self.times[i]))
        if self.rows not in (None, len(frame.means)):
            raise Unordered
        if frame.sh.shape[1] != self.harmonics:
            raise DataError(f"frame {i}: has {frame.sh.shape[1]} harmonics, expected {self.harmonics} as the first has")
        if i not in self.digests:
            self.digests[i] = hashlib.sha256(b"".join(values.tobytes() for values in vars(frame).values())).digest()
        return frame

    @property
    def content(self) -> str:
        """SHA-256 of all frames, which have been read, hexadecimal."""
        return hashlib.sha256(b"".join(self.digests[i] for i in range(len(self)))).hexdigest()


# -- what stands still -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Still:
    """Gaussians of a frame that have stood still since. first: they, in that frame. rows: int64 [m], their numbers
    there. low, high: float32 [m, 10], extremes of what a picture depends on. turn: the least cosine between rotations.
    sums: of values over `count` frames, by names of Splats. reach: of matches; None if frames keep their rows."""

    first: Splats
    rows: np.ndarray
    low: np.ndarray
    high: np.ndarray
    turn: np.ndarray
    sums: dict[str, np.ndarray]
    count: int
    reach: float | None

    @staticmethod
    def of(frame: Splats, reach: float | None) -> Still:
        """Begins with all Gaussians of a frame."""
        values = _values(frame)
        return Still(frame, np.arange(len(values)), values, values, np.ones(len(values)), _sums(frame), 1, reach)

    def find(self, frame: Splats) -> np.ndarray:
        """Returns the row of a frame that is each of the Gaussians, int64 [m], -1 for none."""
        if self.reach is None:
            return self.rows
        found = np.full(len(self.rows), -1)
        here, there = features(self.first, self.first.means, self.reach), features(frame, frame.means, self.reach)
        rows, others = mutual(here, there)
        found[rows] = others
        return found

    def add(self, frame: Splats) -> Still:
        """Returns those that stand still in a further frame too."""
        found = self.find(frame)
        kept = np.flatnonzero(found >= 0)
        own = frame.taken(found[kept])
        values = _values(own)
        low, high = np.minimum(self.low[kept], values), np.maximum(self.high[kept], values)
        turn = np.minimum(self.turn[kept], np.abs(np.einsum("nd,nd->n", own.quats, self.first.quats[kept])))
        size, apart = self.first.scales[kept].max(axis=1), high - low
        still = (apart[:, :3].max(axis=1) < MOVES * size) & (apart[:, 3:].max(axis=1) < MOVES) & (turn > 1 - MOVES**2)
        rows = kept[still]
        sums = {name: self.sums[name][rows] + part[still] for name, part in _sums(own).items()}
        part = {"low": low[still], "high": high[still], "turn": turn[still], "sums": sums, "count": self.count + 1}
        return replace(self, first=self.first.taken(rows), rows=self.rows[rows], **part)

    @cached_property
    def mean(self) -> Splats:
        """Their means over the frames."""
        means = {name: (values / self.count).astype(np.float32) for name, values in self.sums.items()}
        return replace(self.first, **means)

    def others(self, frame: Splats) -> Splats:
        """Returns the other Gaussians of a frame."""
        rest = np.ones(len(frame.means), bool)
        found = self.find(frame)
        rest[found[found >= 0]] = False
        return frame.taken(rest)


def _values(frame: Splats) -> np.ndarray:
    parts = (frame.means, np.log(np.maximum(frame.scales, 1e-12)), frame.opacities[:, None], frame.sh[:, 0])
    return np.concatenate(parts, axis=1)


def _sums(frame: Splats) -> dict[str, np.ndarray]:
    return {name: getattr(frame, name).astype(np.float64) for name in ("means", "scales", "opacities", "sh")}


def groups(
    frames: Frames, cuts: Sequence[int], reach: float | None, step: Callable[[], None]
) -> list[tuple[int, Still]]:
    """Returns (number of the first segment, what stands still) of each group of segments. cuts: frames at their ends.

    A segment joins a group if the base then still saves half of what stands still in the segment, and more than it
    would have to be repeated in the segments before. reach: of matches; None if frames keep their rows, else Unordered
    is raised.
    """
    if reach is None and not in_order(frames):
        raise Unordered
    found = list[tuple[int, Still]]()
    for k, (a, b) in enumerate(zip(cuts[:-1], cuts[1:], strict=True)):
        first, own = frames[a], Still.of(frames[a], reach)
        joined = found[-1][1].add(first) if found else own
        for i in range(a + 1, b + 1):
            frame = frames[i]
            own = own.add(frame)
            joined = joined.add(frame) if found else own
            step()
        before = len(found[-1][1].rows) - len(joined.rows) if found else 0
        if found and 2 * len(joined.rows) >= len(own.rows) and (k - found[-1][0] - 1) * before <= len(joined.rows):
            found[-1] = found[-1][0], joined
        else:
            found.append((k, own))
    return found


# -- bases and segments ------------------------------------------------------------------------------------------------


class BasePacker(Packer):
    """Packs what stands still in a group. views: `count` cameras, and frames of the group."""

    def __init__(
        self,
        still: Still,
        views: Iterable[tuple[Camera, Splats]],
        count: int,
        info: SceneInfo,
        window_step: float | None,
    ):
        self.info, self.key, self.changes, self.grouping, self._step = info, 0, {}, None, window_step
        own, weights = still.mean, Tensors()
        for camera, frame in views:
            shown = together(own, still.others(frame))
            for name, h in sensitivity(Pictures([(camera, shown)], info.background, info.near))[0].items():
                weights[name] = weights.get(name, 0) + h[: len(own.means)] / count
        self.source = stacked(np.zeros(1), [own], None, "")
        if window_step is not None:
            self.source = replace(self.source, windows=np.tile(np.array(ALWAYS, np.float32), (len(own.means), 1)))
        self.ordered = Ordered.of(own, weights)

    def _window_step(self, windows: np.ndarray, coarsest: float) -> float:
        return float(np.float32((self._step or 1.0) / coarsest))


class Backed(Views):
    """Views of a segment's samples, and of the Gaussians of its base, if it has one. more: as many as `looks` wants."""

    def __init__(self, source: Sampled, cameras: Sequence[Camera], behind: Splats | None, *, more: bool = False):
        def at(t: float) -> Splats:
            own = source.near(t)
            return together(behind, own) if behind else own

        times, _ = source.looks(len(cameras))
        super().__init__(at, cameras, times if more else times[: len(cameras)])


def _known(source: Sampled) -> Teacher:
    """The model that knows these samples alone."""
    times = tuple(map(float, source.times))
    return Teacher(lambda t: source.frame(times.index(t), bare=False), times, 1.0)


@dataclass(frozen=True, eq=False)
class Continued(Ordered):
    """Gaussians that are coded by the steps and centres of a base."""

    base: SplatScene

    def grid(self, theta: float, given: dict[str, float] | None = None) -> Grid:
        steps = {name: self.base.steps[name] for name in self.weights if name != "position"}
        steps["position"] = self.base.steps["offset"] * self.voxel_size
        found = super().grid(theta, steps)
        return replace(found, classes=np.minimum(found.classes, classes_of(self.base).max(initial=0)))

    def centre(self, name: str, values: np.ndarray, step: float) -> np.ndarray:
        assert self.base.grading is not None
        ends = np.cumsum([x.shape[1] for x in self.base.tensors.values()])
        parts = dict(zip(self.base.tensors, np.split(self.base.grading.centre, ends[:-1]), strict=True))
        whole = np.concatenate([parts[name], parts.get("harmonics", [])[: values.shape[1] - len(parts[name])]])
        return np.asarray(np.rint(whole / step), np.int32)


class SegmentPacker(Packer):
    """Packs what a segment's base lacks. behind: the Gaussians of the base before they were coded. theta: about that of
    the scene, by which Gaussians are grouped."""

    def __init__(
        self,
        source: Sampled,
        behind: Splats,
        base: SplatScene,
        cameras: Sequence[Camera],
        info: SceneInfo,
        theta: float,
    ):
        self.info, self.key, self.base = info, len(source.times) // 2, base
        self.source = source = canonical(source, self.key)
        weights, _ = sensitivity(Pictures(Backed(source, cameras, behind, more=True), info.background, info.near))
        some = Backed(source, evenly(cameras, CHECKED), behind)
        self.checked = Seen(some, info.background, info.near)
        size, own = base.info.voxel_size, {name: h[len(behind.means) :] for name, h in weights.items()}
        found = Ordered.of(source.frame(self.key), own, lambda at: (size, cells_of(at, size, base.anchor_q)))
        self.ordered: Continued = Continued(**vars(found), base=base)
        self.changes, self.grouping = self._changes() if len(found.rows) else {}, None
        if self.changes:
            self.grouping = Grouping.of(self.changes, place(found.values["position"], info.box), theta)

    def on(self, base: SplatScene) -> SegmentPacker:
        """Returns the packer for the same base with other steps."""
        found = copy(self)
        found.base, found.ordered = base, replace(self.ordered, base=base)
        return found

    def _scene(self, theta: float) -> SplatScene:
        base = replace(self.base, info=replace(self.info, voxel_size=self.base.info.voxel_size))
        return joined(base, super()._scene(theta)) if len(self.ordered.rows) else base

    def _tracks(self, grid: Grid, packed: Packed) -> dict[int, Tracks]:
        finer = replace(grid, steps={name: SEAM * step for name, step in grid.steps.items()})
        return super()._tracks(finer, packed)

    def _window_step(self, windows: np.ndarray, coarsest: float) -> float:
        return self.base.steps["window"]


def together(a: Splats, b: Splats) -> Splats:
    """Returns the Gaussians of both."""
    return Splats(**{name: np.concatenate([part, getattr(b, name)]) for name, part in vars(a).items()})


def classes_of(scene: SplatScene) -> np.ndarray:
    """The step classes uint8 [n] of a graded scene."""
    assert scene.grading is not None
    return scene.grading.classes


def joined(base: SplatScene, added: SplatScene) -> SplatScene:
    """Returns the scene of a segment: the rows of its base, which stand still, and those that it adds."""
    n, classes = len(base.anchor_q), np.concatenate([classes_of(base), classes_of(added)])
    assert base.grading is not None
    m = len(added.anchor_q)
    rows = np.concatenate([np.full(n, m), np.arange(m)])  # tracks have no row m, which therefore stands still
    return replace(
        added,
        rows=tuple(n + rows for rows in added.rows),
        anchor_q=np.concatenate([base.anchor_q, added.anchor_q]),
        mask=tuple(np.concatenate([base.mask[0], codes]) for codes in added.mask),
        grading=Grading(classes, base.grading.centre),
        steps=base.steps,
        tensors={name: np.concatenate([x, added.tensors[name]]) for name, x in base.tensors.items()},
        tracks={layer: tracks.of_rows(rows) for layer, tracks in added.tracks.items()},
    )


# -- the folder --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Made:
    """A folder of segments. psnr: mean in dB over CHECKED pictures of each segment that was made now, None without
    one. kept: the segments that were there already. gaussians: of the first frame. still: of each base."""

    index: Index
    psnr: float | None
    kept: int
    gaussians: int
    still: list[int]


@one_blas_thread()
def import_segments(
    place: str,
    folder: str,
    *,
    length: float,
    psnr: float,
    fps: float | None = None,
    seconds: float | None = None,
    background: tuple[float, float, float] | None = None,
    up: tuple[float, float, float] | None = None,
    metadata: Metadata | None = None,
    overwrite: bool = False,
    tell: Callable[[str], None],
    progress: Progress,
) -> Made:
    """Packs the model at `place` for `psnr` dB into segments of about `length` seconds, and writes them and their index
    to `folder`. Segments that the index there lists already are kept if they are of the same import.

    Others as in `imported.import_model`. Raises DataError, also for a folder of another import without `overwrite`.
    """
    check_path(folder)
    model = read_model(place, fps := fps or FPS, seconds)
    total = float(np.float32(seconds or model.seconds))
    times = model.times or tuple(np.linspace(0, 1, max(round(total * fps), 1) + 1))
    if len(times) < 2:
        raise DataError(f"{place}: stands still, expected frames for --segments")
    frames, last = Frames(model, times), len(times) - 1
    count = max(round(total / length), math.ceil(last / (MAX_SIDE - 1)), 1)
    cuts = [round(i * last / count) for i in range(count + 1)]
    if count > last:
        raise DataError(f"{place}: has {last + 1:,} frames in {total:g} s, expected two at least in each segment")
    target, index = Path(folder), Index((), ())
    made: dict[str, Any] = {"source": place, "frames": len(times), "seconds": total, "cuts": count, "psnr": psnr}
    text = metadata or Metadata()
    made |= {"background": background and list(background), "up": up and list(up)}
    made |= {"texts": [text.title, text.source, text.licence], "content": None, "theta": []}
    if (target / INDEX).exists() and not overwrite:
        index = parse((target / INDEX).read_bytes(), str(target / INDEX))
        made |= {"theta": (theta := index.made.get("theta")), "content": index.made.get("content")}
        if index.made != made or not isinstance(theta, list) or len(theta) != len(index.bases):
            raise DataError(f"{target}: holds another import; --overwrite replaces it")
    target.mkdir(parents=True, exist_ok=True)

    first = frames[0]
    with progress("looking for what stands still", last) as step:
        try:
            found, reach = groups(frames, cuts, None, step), None
        except Unordered:
            frames.rows, reach = None, reach_of(first)
            found = groups(frames, cuts, reach, step)
    if made["content"] not in (None, frames.content):
        raise DataError(f"{target}: was made of other Gaussians than {place} holds now; --overwrite replaces it")
    made["content"] = frames.content
    some = [frames[i] for i in evenly(range(len(times)), BOX_INSTANTS)]
    info, cameras, judges = scene_info(place, model, some, total, background, up)
    still = [len(own.rows) for _, own in found]
    rests = ", ".join(f"{n:,} stand still from segment {k} on" for n, (k, _) in zip(still, found, strict=True))
    what = f"{len(first.means):,} Gaussians, {len(times):,} frames in {total:.3g} s, {count} segments"
    tell(f"{place}: {what}; {rests}; seen by {seen_by(place)}")
    writer = _Writer(target, index, made, frames, cuts, info, cameras, [c for c, _ in judges], psnr, text, reach)
    measured = list[float]()
    with progress("packing", count) as step:
        for (start, own), stop in zip(found, [k for k, _ in found[1:]] + [count], strict=True):
            group = writer.group(own, range(start, stop))
            for k in range(start, stop):
                measured += writer.segment(k, group)
                step()
    quality = float(np.mean(measured)) if measured else None
    return Made(writer.index, quality, count - len(measured), len(first.means), still)


@dataclass(frozen=True, eq=False)
class Group:
    """A base, by its number in the index, as a file and as a scene; what it holds, before it was coded; and the theta
    of its steps."""

    number: int
    base: Base
    scene: SplatScene
    still: Still
    theta: float


class _Writer:
    """Makes the files of a folder, one after the other, and its index after each."""

    def __init__(
        self, folder: Path, before: Index, made: dict[str, Any], frames: Frames, cuts: Sequence[int], info: SceneInfo,
        cameras: Sequence[Camera], judges: Sequence[Camera], psnr: float, about: Metadata, reach: float | None,
    ):  # fmt: skip
        self.folder, self.before, self.made, self.frames, self.cuts = folder, before, made, frames, cuts
        self.info, self.cameras, self.judges, self.psnr, self.about = info, cameras, judges, psnr, about
        self.reach = reach
        self.index = Index((), (), made)

    def _info(self, a: int, b: int) -> SceneInfo:
        """The info of a part of the time, between two frames."""
        low, high = (self.frames.times[i] * self.made["seconds"] for i in (a, b))
        return replace(self.info, time_range=seconds_range(low, high))

    def _kept(self, file: File | None) -> bytes | None:
        """The bytes of a file of an earlier run; None if they are not there, or others."""
        if file is None or not (path := self.folder / file.file).is_file():
            return None
        with contextlib.suppress(DataError):
            check(file, data := path.read_bytes(), str(path))
            return data
        return None

    def _write(self, name: str, data: bytes, index: Index) -> None:
        write_bytes(self.folder / name, data, overwrite=True)
        self.index = index
        write_bytes(self.folder / INDEX, index.packed(), overwrite=True)

    def samples(self, k: int, still: Still | None) -> Sampled:
        """What a segment does not share with its base."""
        a, b = self.cuts[k], self.cuts[k + 1]
        times = np.array(self.frames.times[a : b + 1])
        times = (times - times[0]) / (times[-1] - times[0])
        frames = (self.frames[i] for i in range(a, b + 1))
        rest = [still.others(frame) if still else frame for frame in frames]
        if self.reach is None or not any(len(frame.means) for frame in rest):
            return stacked(times, rest, None, "")
        return matched_frames(f"segment {k}", times, rest, self.reach)

    def group(self, still: Still, own: range) -> Group | None:
        """Makes the base of a group of segments; None if it would save nothing."""
        if len(own) < 2 or not len(still.rows):
            return None
        g = len(self.index.bases)
        name, old = f"base-{g:04d}.pd4", self.before.bases[g] if g < len(self.before.bases) else None
        data = self._kept(old)
        if data is None:
            data, theta = self._base(still, own)
            self.made["theta"][g:] = [theta]
        self._write(name, data, replace(self.index, bases=(*self.index.bases, file_of(name, data))))
        scene = decode(data)
        assert isinstance(scene, SplatScene)
        return Group(g, read_base(data), scene, still, float(self.made["theta"][g]))

    def _base(self, still: Still, own: range) -> tuple[bytes, float]:
        """Returns a base and its theta, at which the first segment has the dB that are asked for."""
        a, b = self.cuts[own[0]], self.cuts[own[-1] + 1]
        chosen = sorted(a + round(t * (b - a)) for t in spread(len(self.cameras)))
        views = ((camera, self.frames[i]) for camera, i in zip(self.cameras, chosen, strict=True))
        precise = None if self.reach is None else PRECISE / int(np.diff(self.cuts).max())
        packer = BasePacker(still, views, len(self.cameras), self._info(a, b), precise)
        guess, source = 10 ** (-self.psnr / 10) / packer.scalars, self.samples(own[0], still)
        info = self._info(a, self.cuts[own[0] + 1])
        first = SegmentPacker(source, still.mean, packer._scene(guess), self.cameras, info, guess)

        def build(theta: float) -> tuple[tuple[float, SplatScene], float]:
            scene = packer._scene(theta)
            here = first.on(scene)
            return (theta, scene), here._psnr(here._scene(theta), here.checked) - self.psnr

        theta, scene = matched(build, guess)
        data, _ = encode_with_report(scene)
        return with_metadata(data, self.about)[0], theta

    def segment(self, k: int, group: Group | None) -> list[float]:
        """Makes a segment; returns [dB of its pictures], [] if it was there already."""
        info = self._info(self.cuts[k], self.cuts[k + 1])
        number, base, still = (group.number, group.base, group.still) if group else (None, None, None)
        old = self.before.segments[k] if k < len(self.before.segments) else None
        data = self._kept(old) if old and (old.base, old.time_range) == (number, info.time_range) else None
        if data and group and (about(data)["base"] or {}).get("digest") != group.base.reference.digest.hex():
            data = None
        quality = list[float]()
        if data is None:
            source = self.samples(k, still)
            if group and still:
                packer: Packer = SegmentPacker(source, still.mean, group.scene, self.cameras, info, group.theta)
                scene = packer._scene(group.theta)
            else:
                packer = Packer(_known(source), source, self.cameras, info, lambda: None)
                scene = packer.matched(self.psnr)
            data, _ = encode_with_report(scene, base=base)
            decoded = decode(data, base=base)
            assert isinstance(decoded, SplatScene)
            quality = [self._quality(decoded, packer.source, still.mean if still else None)]
            data, _ = with_metadata(data, Metadata(quality={decoded.level: quality[0]}))
        file = file_of(f"{k:05d}.pd4", data)
        segment = Segment(**vars(file), time_range=info.time_range, base=number)
        self._write(file.file, data, replace(self.index, segments=(*self.index.segments, segment)))
        return quality

    def _quality(self, scene: SplatScene, source: Sampled, behind: Splats | None) -> float:
        """Returns the mean PSNR in dB from cameras that decided nothing."""
        views = Backed(source, evenly(self.judges, CHECKED), behind)
        images = Pictures(views, self.info.background, self.info.near).images
        return mean_psnr(scene, zip(views.cameras, views.times, images, strict=False))
