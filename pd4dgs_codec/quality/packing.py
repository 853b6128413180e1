"""One call from a scene to a `.pd4` file: layers that do not pay left out, layers made to fit, the rest encoded."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.format.encoder import Report, encode_with_report, with_metadata
from pd4dgs_codec.format.left_out import LeftOut
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.plan import plan
from pd4dgs_codec.format.stream import every_prefix
from pd4dgs_codec.format.symbols import rounded
from pd4dgs_codec.quality import MIN_GAIN_PER_MEGABYTE
from pd4dgs_codec.scene import Scene

if TYPE_CHECKING:
    import numpy as np

    from pd4dgs_codec.data.view import Dataset, View
    from pd4dgs_codec.model.model import Model
    from pd4dgs_codec.quality.frames import Frame

#: Pictures of the file's own camera, and how many degrees it sways, where there are no views.
OWN_PICTURES, OWN_ORBIT = 16, 20.0

#: What is being done, in two words -> a context with a function to call after each picture.
Progress = Callable[[str], AbstractContextManager[Callable[[], None]]]


def no_progress(_: str) -> AbstractContextManager[Callable[[], None]]:
    """Tells nothing."""
    return nullcontext(lambda: None)


@dataclass(frozen=True)
class Views:
    """What packing looks at. source: where they are from, for the report. fitting: sizes are fitted on these. held_out:
    layers must pay on these, for on what it was fitted to a useless one may still gain a lot."""

    source: str
    fitting: Sequence[View]
    held_out: Sequence[View] = ()

    @classmethod
    def of(cls, dataset: Dataset, source: str, most: int) -> Views:
        """About `most` training views and as many held out (training views if none are), evenly spread."""
        fitting, held_out = (
            tuple(views[:: -(-len(views) // most)]) for views in (dataset.train, dataset.test or dataset.train)
        )
        return cls(source, fitting, held_out)


@dataclass(frozen=True)
class Packed:
    """A `.pd4` file. scene: what was encoded, at the steps of the file. target: how sizes were met, or None where none
    were asked for: cameras, pictures, layers (as in target.Fit) and levels (level, error_psnr in dB against the
    unquantised pictures, and with held-out views lost_db, their mPSNR). slices: of a sliced file, by what its anchors
    are ordered, in how many pictures, and with held-out views the mPSNR in dB after each slice; else None."""

    data: bytes
    scene: Scene
    report: Report
    target: dict[str, Any] | None
    slices: dict[str, Any] | None = None

    def json(self) -> dict[str, Any]:
        """The report, with the target and per layer the ratio of payload to R(a)."""
        result = self.report.json()
        if self.target is not None:
            result["target"] = self.target
        if self.slices is not None:
            result["slices"] = self.slices
        for row in result["layers"]:
            row["ratio"] = row["payload_bits"] / row["rate_bits"] if row["rate_bits"] else None
        return result


def pack(
    source: Scene | Model,
    options: EncodeOptions = DEFAULTS,
    *,
    target_sizes: Mapping[int, int] | None = None,
    views: Views | None = None,
    min_gain: float = MIN_GAIN_PER_MEGABYTE,
    downscale: int = 1,
    metadata: Metadata | None = None,
    progress: Progress = no_progress,
) -> Packed:
    """The file of a scene or a trained model.

    target_sizes: most bytes that each layer may add to the file, by layer. views: pictures to judge by; without them
    sizes are fitted on what the file's own camera shows, 1/downscale as wide and high, and no layer must pay. min_gain:
    dB of mPSNR per megabyte under which a layer is left out, where all layers are asked for; 0 keeps all. metadata:
    what the file says about itself. If options.slices, anchors come in the order of what they gain in the views that
    sizes are fitted on, or in what the file's own camera shows; a file without either has the largest first. Only
    views, target sizes and slices need torch. Raises EncodeError, RenderError for a file without a camera.
    """
    if not isinstance(source, Scene):
        from pd4dgs_codec.model.convert import to_scene

        source = to_scene(source)
    scene, options = options.apply_scale(source)
    left_out: list[LeftOut] = []
    if views is not None and views.held_out and options.layers == "auto" and min_gain:
        from pd4dgs_codec.quality.gains import leave_out_unpaid

        with progress("judging layers") as step:
            scene, left_out = leave_out_unpaid(scene, views.held_out, min_gain=min_gain, options=options, step=step)
    target = None
    if target_sizes:
        scene, more, target = _fit(scene, options, target_sizes, views, downscale, progress)
        left_out += more
    if options.slices:
        return _in_slices(scene, options, left_out, target, views, downscale, metadata, progress)
    data, report = encode_with_report(scene, options, left_out=left_out, metadata=metadata)
    _note_sizes(target, report)
    return Packed(data, scene, report, target)


def _note_sizes(target: dict[str, Any] | None, report: Report) -> None:
    if target is not None:
        added = report.added_bytes()
        for row in target["layers"]:
            row["bytes"] = added.get(row["layer"], 0)


def _in_slices(
    scene: Scene,
    options: EncodeOptions,
    left_out: list[LeftOut],
    target: dict[str, Any] | None,
    views: Views | None,
    downscale: int,
    metadata: Metadata | None,
    progress: Progress,
) -> Packed:
    from pd4dgs_codec.model.utility import utility
    from pd4dgs_codec.quality.rendered import true_psnr

    about: dict[str, Any] = {"order": "gate times area", "cameras": None, "pictures": 0}
    order: Callable[[Scene], np.ndarray] | None = None
    frames = _frames(scene, views, downscale) if views is not None or scene.info.camera is not None else []
    if frames:
        about = {"order": "rendered gain per byte", "cameras": _cameras(views), "pictures": len(frames)}

        def order(decoded: Scene) -> np.ndarray:
            with progress("ordering anchors") as step:
                return utility(decoded, [(frame.camera, frame.time) for frame in frames], step)

    data, report = encode_with_report(scene, options, left_out=left_out, utility=order)
    _note_sizes(target, report)
    if views is not None and views.held_out:
        with progress("judging slices") as step:
            about["psnr"] = [
                true_psnr(prefix, views.held_out, step, levels=[prefix.level])[prefix.level]
                for prefix in every_prefix(data)
            ]
        metadata = replace(metadata or Metadata(), slices=tuple(about["psnr"]))
    if metadata is not None:
        plain, data = len(data), with_metadata(data, metadata)
        report = replace(report, bytes=len(data), metadata_bytes=len(data) - plain)
    return Packed(data, scene, report, target, about)


def _frames(scene: Scene, views: Views | None, downscale: int) -> list[Frame]:
    """The pictures to fit to."""
    from pd4dgs_codec.quality.frames import dataset_frames, own_frames

    if views is None:
        return own_frames(scene.info, OWN_PICTURES, OWN_ORBIT, downscale)
    return dataset_frames(views.fitting)


def _cameras(views: Views | None) -> str:
    return "the file's own camera" if views is None else f"training views of {views.source}"


def _fit(
    scene: Scene,
    options: EncodeOptions,
    target_sizes: Mapping[int, int],
    views: Views | None,
    downscale: int,
    progress: Progress,
) -> tuple[Scene, list[LeftOut], dict[str, Any]]:
    """(scene whose layers meet the sizes, what that leaves out, the target of the report)."""
    from pd4dgs_codec.quality.rendered import RenderedLoss, psnr_of, true_psnr
    from pd4dgs_codec.quality.target import fit

    scene, left_out = plan(scene, options)
    frames = _frames(scene, views, downscale)
    held_out = () if views is None else views.held_out
    with progress("fitting sizes") as step:
        loss = RenderedLoss(scene, frames, step)
        fitted, dropped, fits = fit(scene, target_sizes, loss.mean_mse, loss.harm, options)
        packed = rounded(plan(fitted, replace(options, omit="nothing"))[0])
        errors = loss.mse(packed)
        before, after = (true_psnr(s, held_out, step) if held_out else {} for s in (scene, packed))
    levels = []
    for level, mse in errors.items():
        lost = {"lost_db": before[level] - after[level]} if held_out else {}
        levels.append({"level": level, "error_psnr": psnr_of(mse), **lost})
    report = {
        "cameras": _cameras(views),
        "pictures": len(frames),
        "layers": [asdict(row) for row in fits],
        "levels": levels,
    }
    return fitted, left_out + dropped, report
