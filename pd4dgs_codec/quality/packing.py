"""Packs a scene into a `.pd4` file: fits target sizes, orders slices, encodes the rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from typing import TYPE_CHECKING, Any

from pd4dgs_codec.data.view import spread, thinned
from pd4dgs_codec.errors import EncodeError
from pd4dgs_codec.format.decoder import decode, every_prefix
from pd4dgs_codec.format.encoder import Report, encode_with_report, with_metadata
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.options import DEFAULTS, EncodeOptions
from pd4dgs_codec.format.plan import LeftOut, plan
from pd4dgs_codec.kinds import AnyScene
from pd4dgs_codec.quality.frames import own_frames
from pd4dgs_codec.scene import LayeredScene, Scene, SceneInfo, Viewpoint
from pd4dgs_codec.tensors.tables import Fill

if TYPE_CHECKING:
    import numpy as np

    from pd4dgs_codec.data.view import Dataset, View
    from pd4dgs_codec.model.model import Model

#: Without a dataset: the number of pictures that decide, and the degrees by which the file's own camera orbits.
OWN_PICTURES, OWN_ORBIT = 16, 20.0

#: The current task in two words -> a context whose value is called after each picture.
Progress = Callable[[str], AbstractContextManager[Callable[[], None]]]


@dataclass(frozen=True)
class Views:
    """The views that packing uses. source: where they come from, for the report. fitting: for target sizes and the
    order of slices. held_out: for the reported mPSNR; they decide nothing. checking: in their absence, for the
    reported mPSNR against the scene's own pictures."""

    source: str
    fitting: Sequence[Viewpoint]
    held_out: Sequence[View] = ()
    checking: Sequence[Viewpoint] = ()

    @classmethod
    def of(cls, dataset: Dataset, source: str, most: int) -> Views:
        """Picks about `most` training and as many held-out views (training views if there are none), evenly spread."""
        fitting = [(view.camera, view.time) for view in spread(dataset.train, most)]
        return cls(f"training views of {source}", fitting, thinned(dataset.test or dataset.train, most))

    @classmethod
    def remembered(cls, viewpoints: Sequence[Viewpoint]) -> Views:
        """The training cameras of a checkpoint: the first ones decide, the others check."""
        return cls("training cameras in the checkpoint", viewpoints[:OWN_PICTURES], (), viewpoints[OWN_PICTURES:])

    @classmethod
    def own(cls, info: SceneInfo) -> Views:
        """The file's own camera. Raises RenderError if the file has none, or its pictures are too large."""
        frames = own_frames(info, OWN_PICTURES, OWN_ORBIT)
        return cls("the file's own camera", [(frame.camera, frame.time) for frame in frames])


@dataclass(frozen=True)
class Packed:
    """A `.pd4` file. scene: the encoded scene, at the steps of the file.

    target: how target sizes were met, or None: cameras, pictures, layers (the fields of target.Fit) and levels (level,
    error_psnr in dB relative to the unquantised pictures, and with held-out views lost_db, their loss of mPSNR).
    slices: of a sliced file, or None: size, the limit in bytes, order, the criterion by which anchors are sorted,
    cameras, pictures, and with held-out views psnr, the mPSNR in dB after each slice. If anchors may pass to later
    layers also levels (level, mpsnr and mpsnr_unsliced in dB), and against, what these are measured on.
    """

    data: bytes
    scene: AnyScene
    report: Report
    target: dict[str, Any] | None
    slices: dict[str, Any] | None = None

    def json(self) -> dict[str, Any]:
        """Returns the report with the target, the slices and per layer the ratio of payload to R(a)."""
        more = {"target": self.target, "slices": self.slices}
        result = self.report.json() | {name: value for name, value in more.items() if value is not None}
        for row in result["layers"]:
            row["ratio"] = row["payload_bits"] / row["rate_bits"] if row["rate_bits"] else None
        return result


def pack(
    source: AnyScene | Model,
    options: EncodeOptions = DEFAULTS,
    *,
    target_sizes: Mapping[int | None, int] | None = None,
    views: Views | None = None,
    keep_levels: bool = False,
    metadata: Metadata | None = None,
    progress: Progress = lambda _: nullcontext(lambda: None),
) -> Packed:
    """Packs a scene or a trained model into a file.

    target_sizes: the most bytes that each layer may add to the file, by layer, or {None: the most bytes of the file}.
    views: for target sizes and the order of slices; without views the pictures are of the file's own camera. metadata:
    stored in the file. With options.slices anchors are ordered by the pictures' gain per byte, and without target
    sizes or keep_levels some pass to later layers, see `measure.in_order`. Every slice but the last gets its fill from
    half of these pictures, see `measure.best_fill`. Without views or a camera the largest anchors come first.

    Only target sizes, and slices that views order, need torch. Raises EncodeError, also for target sizes of splats, and
    RenderError for target sizes without a camera.
    """
    if not isinstance(source, LayeredScene):
        from pd4dgs_codec.model.model import to_scene

        source = to_scene(source)
    scene, options = options.apply_scale(source)
    networks = isinstance(scene, Scene)
    if target_sizes and not networks:
        raise EncodeError("target sizes of a scene of splats, whose steps pd4dgs-import chooses, expected a scaffold")
    if views is None and networks and (target_sizes or (options.slices and scene.info.camera)):
        views = Views.own(scene.info)
    pictures = _Pictures(views, progress)
    if target_sizes and isinstance(scene, Scene):
        return pictures.fit(scene, options, target_sizes, metadata)
    data, report, slices = pictures.write(scene, options, [], metadata, passing=networks and not keep_levels)
    return Packed(data, scene, report, None, slices)


@dataclass(frozen=True)
class _Pictures:
    """The pictures that packing measures, and the parts of packing that need them."""

    views: Views | None
    progress: Progress

    @property
    def held_out(self) -> Sequence[View]:
        return () if self.views is None else self.views.held_out

    def fit(
        self, scene: Scene, options: EncodeOptions, target_sizes: Mapping[int | None, int], metadata: Metadata | None
    ) -> Packed:
        """Returns the file whose layers meet the sizes."""
        from pd4dgs_codec.quality.measure import RenderedLoss, true_psnr
        from pd4dgs_codec.quality.target import Fitter

        planned = plan(scene, options)
        assert self.views and isinstance(planned.scene, Scene)
        scene, left_out = planned.scene, planned.left_out
        viewpoints = self.views.fitting
        with self.progress("fitting sizes") as step:
            loss = RenderedLoss(scene, viewpoints, step)
            fitter = Fitter(scene, target_sizes, loss.mean_mse, loss.omission_error, options)
            met = False
            while not met:
                fitted, dropped, fits = fitter.fit()
                data, report, slices = self.write(fitted, options, left_out + dropped, metadata, passing=False)
                added = dict[int | None, int]([(None, report.bytes), *report.added_bytes().items()])
                met = True
                for row in fits:
                    if (size := added.get(row.layer, 0)) > row.target:  # slices in another order than measured
                        met, fitter.growth[row.layer] = False, fitter.growth[row.layer] * size / row.bytes
            packed = plan(fitted, replace(options, omit="nothing")).symbols.scene()
            errors = loss.mse(packed)
            held_out = self.held_out
            before, after = (true_psnr(s, errors, held_out, step) if held_out else {} for s in (scene, packed))
        levels = []
        for level, mse in errors.items():
            lost = {"lost_db": before[level] - after[level]} if before else {}
            levels.append({"level": level, "error_psnr": -10.0 * math.log10(mse) if mse else math.inf, **lost})
        layers = [asdict(row) | {"bytes": added.get(row.layer, 0)} for row in fits]
        target = {"cameras": self.views.source, "pictures": len(viewpoints), "layers": layers, "levels": levels}
        return Packed(data, fitted, report, target, slices)

    def write(
        self,
        scene: AnyScene,
        options: EncodeOptions,
        left_out: list[LeftOut],
        metadata: Metadata | None,
        *,
        passing: bool,
    ) -> tuple[bytes, Report, dict[str, Any] | None]:
        """Returns (file, report, slices of the report if it has slices). passing: whether anchors may then pass to
        later layers."""
        if not options.slices:
            return *encode_with_report(scene, options, left_out=left_out, metadata=metadata), None
        order_of = "gate" if isinstance(scene, Scene) else "opacity"
        about: dict[str, Any] = {"order": f"{order_of} times area", "cameras": None, "pictures": 0}
        about["size"] = options.slices
        if self.views is None:
            return *encode_with_report(scene, options, left_out=left_out, metadata=metadata), about
        from pd4dgs_codec.draw.player import drawer
        from pd4dgs_codec.model.sensitivity import smaller
        from pd4dgs_codec.quality.measure import best_fill, in_order, own_views, true_psnr

        views, planned = self.views, plan(scene, options)
        small, player = [(smaller(camera), time) for camera, time in views.fitting], drawer(planned.scene)
        shown = [player.picture(camera, time) for camera, time in small]
        fills = dict[int, Fill | None]()  # the latest of each level; after one that gains nothing, none does

        def fill(prefix: AnyScene) -> Fill | None:
            level = prefix.level
            if fills.setdefault(level, ()) is not None:  # half of the pictures is enough for a colour
                fills[level] = best_fill(prefix, small[::2], shown[::2], fills[level])
            return fills[level]

        order: Callable[[AnyScene], np.ndarray] | None = None
        if isinstance(planned.scene, Scene):
            about |= {"order": "rendered gain per byte", "cameras": views.source, "pictures": len(views.fitting)}
            left_out = [*left_out, *planned.left_out]
            with self.progress("ordering anchors") as step:
                scene, values = in_order(planned.scene, small, shown, options, step, passing=passing)

            def order(_: AnyScene) -> np.ndarray:
                return values

        data, report = encode_with_report(scene, options, left_out=left_out, utility=order, fill=fill)
        if self.held_out:
            with self.progress("measuring slices") as step:
                about["psnr"] = [
                    true_psnr(prefix, [prefix.level], self.held_out, step)[prefix.level]
                    for prefix in every_prefix(data)
                ]
            metadata = replace(metadata or Metadata(), slices=tuple(about["psnr"]))
        if passing:
            assert isinstance(planned.scene, Scene)
            with self.progress("measuring levels") as step:
                judges = views.held_out or own_views(planned.scene, views.checking or views.fitting)
                whole = true_psnr(planned.symbols.scene(), scene.layers, judges, step)
                if views.held_out:
                    ends = accumulate(len(row.slices) for row in report.layers)
                    sliced = {row.layer: about["psnr"][end - 1] for row, end in zip(report.layers, ends, strict=True)}
                else:
                    sliced = true_psnr(decode(data), scene.layers, judges, step)
            about["against"] = "held-out views" if views.held_out else "the model's own pictures"
            about["levels"] = [
                {"level": level, "mpsnr": sliced[level], "mpsnr_unsliced": whole[level]} for level in scene.layers
            ]
        if metadata is not None:
            data, about_bytes = with_metadata(data, metadata)
            report = replace(report, bytes=len(data), metadata_bytes=about_bytes)
        return data, report, about
