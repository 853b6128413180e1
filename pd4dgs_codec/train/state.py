"""The state of a model in training, on which the steps and the phases of a run work."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from pd4dgs_codec.data.view import Dataset, View, shrunk_view
from pd4dgs_codec.model.config import PRESETS, ModelConfig
from pd4dgs_codec.model.model import Model
from pd4dgs_codec.model.networks import EXACT, Noise, Rounding
from pd4dgs_codec.quality.measure import level_psnr
from pd4dgs_codec.scene import MASK_THRESHOLD, instant
from pd4dgs_codec.train.config import MOST_STEPS, TrainConfig
from pd4dgs_codec.train.following import Track
from pd4dgs_codec.train.initialise import check_visible, fresh_model, start_points
from pd4dgs_codec.train.optimiser import PER_ANCHOR, Optimiser
from pd4dgs_codec.train.schedule import Schedule
from pd4dgs_codec.train.ssim import Part, pixel_weights, within_reach

#: Bytes of images on the device, weights included, beyond which the least recently used are dropped.
KEPT_BYTES = 1 << 30
#: Pixels of the shorter side from which pictures are reduced at first: reducing smaller ones saves little time.
LARGE = 400


@dataclass(frozen=True, eq=False)
class TrainingView:
    """A view of the dataset on the device.

    pixels: uint8 [H, W, 3]. weights: float32 [H, W], see `pixel_weights`. rows, columns: bool [H] and [W], whether
    a row or column differs from the background. visible: the number of pixels that do. exposure: [2, 3], see
    `TrainingViews`; None with a single camera.
    """

    view: View
    pixels: Tensor
    weights: Tensor
    rows: Tensor
    columns: Tensor
    visible: int
    exposure: Tensor | None = None

    @staticmethod
    def of(
        view: View, background: Sequence[float], device: torch.device, exposure: Tensor | None = None
    ) -> TrainingView:
        """Copies the image to the device."""
        pixels = torch.as_tensor(np.require(view.image, requirements="W"), device=device)  # torch warns of others
        mask = torch.ones(pixels.shape[:2], device=device)
        if view.mask is not None:
            mask = torch.as_tensor(np.require(view.mask, requirements="W"), device=device).float()
        shown = (pixels != torch.tensor(background, device=device) * 255).any(2)
        return TrainingView(view, pixels, pixel_weights(mask), shown.any(1), shown.any(0), int(shown.sum()), exposure)

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return self.pixels.nbytes + self.weights.nbytes

    @property
    def image(self) -> Tensor:
        """float32 [H, W, 3], 0..1."""
        return self.pixels.float() / 255

    def exposed(self, image: Tensor) -> Tensor:
        """A picture [H, W, 3] of this view as its camera exposes it."""
        return image if self.exposure is None else image * self.exposure[0].exp() + self.exposure[1]

    def content(self, alpha: Tensor) -> Part:
        """The rows and columns that the loss of a picture with `alpha` [H, W] depends on: elsewhere the picture and the
        image show the background."""
        rows, columns = (alpha.detach().amax(axis).bool() for axis in (1, 0))
        return within_reach(self.rows | rows), within_reach(self.columns | columns)

    def squared_error(self, image: Tensor) -> float:
        """The squared error of a picture [H, W, 3] of this view, summed over colours and weighted pixels."""
        return float(((self.exposed(image) - self.image).detach().square().sum(-1) * self.weights).sum())


class TrainingViews:
    """A dataset's training views, copied to the device on demand, where KEPT_BYTES of them stay.

    exposures: by camera, [2, 3], logarithms of gains and offsets per channel by which its pictures differ from the mean
    of all cameras; empty with a single camera. They are trained, but not packed. Without them the colours in one
    camera's direction take on its exposure, and haze in front of it imitates it.
    """

    def __init__(self, views: Sequence[View], background: Sequence[float], device: torch.device):
        self.views, self.background, self.device = views, background, device
        cameras = sorted({view.camera_id for view in views})
        several = cameras if len(cameras) > 1 else []
        self.exposures = {camera: nn.Parameter(torch.zeros(2, 3, device=device)) for camera in several}
        self._kept: OrderedDict[tuple[int, int], TrainingView] = OrderedDict()
        self._bytes = 0

    def __len__(self) -> int:
        return len(self.views)

    def spread(self, most: int, among: Sequence[int] | None = None, turn: int = 0) -> list[TrainingView]:
        """At most `most` of the views `among` (default: all), evenly spread; other ones in another `turn`."""
        among = range(len(self)) if among is None else among
        stride = -(-len(among) // most)
        if not self.exposures:
            return [self[index] for index in among[turn % stride :: stride]]
        # views are often listed by instant, then camera: a constant stride could meet one camera only
        blocks = enumerate(range(0, len(among), stride))
        chosen = [start + (turn + k) % min(stride, len(among) - start) for k, start in blocks]
        return [self[among[i]] for i in chosen]

    @torch.no_grad()
    def centre_exposures(self) -> None:
        """Subtracts the mean of the exposures, which belongs to the model's colours."""
        if self.exposures:
            mean = torch.stack(list(self.exposures.values())).mean(0)
            for exposure in self.exposures.values():
                exposure.sub_(mean)

    def __getitem__(self, index: int) -> TrainingView:
        return self.reduced(index, 1)

    def reduced(self, index: int, k: int) -> TrainingView:
        """View `index`, at 1/k of its size if its shorter side has LARGE pixels or more."""
        view = self.views[index]
        k = k if min(view.width, view.height) >= LARGE else 1
        found = self._kept.pop((index, k), None)
        if found is None:
            exposure = self.exposures.get(view.camera_id)
            found = TrainingView.of(shrunk_view(view, k), self.background, self.device, exposure)
            self._bytes += found.nbytes
        self._kept[index, k] = found
        while self._bytes > KEPT_BYTES and len(self._kept) > 1:
            self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return found


class TrainState:
    """A model in training.

    All random numbers come from two generators whose states checkpoints hold. On the CPU, a resumed run thus repeats
    the uninterrupted one bit for bit at a fixed number of iterations and threads; on CUDA the order of sums varies.

    schedule: the run's schedule; a timed run replaces it once, when it has estimated its length.
    iteration: steps done, skipped ones included. skipped: steps whose loss or gradient was not finite.
    share: in a timed run the share of the schedule that is done, 0..1, set by Trainer; None otherwise.
    statistics: [N] or [N, slots] per anchor, on which growing depends, see `fresh_statistics`.
    tracks: of what moves, for `phases.follow`; none if `start` was given.
    order: training views drawn and not yet used, the next one last.
    rho: moving average of how much the masks of levels 0 and 2 differ.
    practising: a trial is running; all views and pixels train level 0, see `phases.levels`.
    opened: all views train motion, see `phases.opening`. placing: all views train anchors before, see `phases.follow`.
    guided: points of what moves were found, and it is most of what views show, see `phases.matching`.
    """

    def __init__(
        self,
        config: TrainConfig,
        dataset: Dataset,
        schedule: Schedule,
        device: torch.device,
        size: ModelConfig | None = None,
        start: Model | None = None,
    ):
        """Starts with the model `start`, by default with a fresh one for `dataset`, of the preset's size by default."""
        self.config, self.dataset, self.schedule, self.device = config, dataset, schedule, device
        self.size = size or PRESETS[config.preset]
        steps = config.model_steps(self.size.steps)
        key = config.key_instant if config.rollout == "key" else None
        self.tracks: list[Track] = []
        if start is None:
            placed, moving, self.tracks = start_points(dataset, key, config.max_layer > 0)
            shape = config.widths, steps, config.seed, config.max_layer
            start = fresh_model(self.size, placed, *shape, key, moving)
        check_visible(start, dataset)
        self.model = start.to(device)
        self.views = TrainingViews(dataset.train, start.info.background, device)
        self.optimiser = Optimiser(self.model, config.rates, config.cooldown, self.views.exposures.values())
        self.generator = torch.Generator().manual_seed(config.seed)
        self.noise = Noise(config.seed + 1, device)
        self.statistics = fresh_statistics(len(start.anchor_q), config.slots)
        self.iteration = self.skipped = 0
        self.share: float | None = None
        self.rho, self.practising, self.opened, self.placing, self.guided = 0.0, False, False, False, False
        self.order: list[int] = []
        self._before = -1  #: the previous step's position; a timed run may advance by more than one

    # -- where the run stands --------------------------------------------------------------------------------------

    @property
    def position(self) -> int:
        """The next step's position in the schedule, 0..N: the steps done, or in a timed run the `share` of N."""
        return self.iteration if self.share is None else int(self.share * (self.schedule.iterations or 0))

    @property
    def key(self) -> float | None:
        """The key instant, normalised time; None without one, or without layer 1."""
        field = self.model.global_deformation
        return None if field is None or field.key is None else instant(field.key)

    def reached(self, start: float) -> bool:
        """Whether this step is the first at or past position `start`."""
        return (self.position - 1 if self.share is None else self._before) < start <= self.position

    def steps_in(self, share: float) -> int:
        """How many steps a share of the run takes at its pace so far; in a timed run, N only estimates this pace."""
        return round(share * self.iteration / max(self.schedule.progress(self.position), 1e-9))

    @property
    def coarse(self) -> bool:
        """Whether nothing teaches motion at this step."""
        return self.position < self.schedule.coarse_end and not self.model.frozen

    @property
    def guiding(self) -> bool:
        """Whether pictures of motion train nothing but motion at this step."""
        return self.guided and self.position < self.schedule.progressive

    def rounding(self, *, noisy: bool = True) -> Rounding:
        """How the steps at this position simulate quantisation; without noise if not `noisy`."""
        if not self.config.noise:
            return EXACT
        exact = self.position >= self.schedule.exact_rounding
        noise = noisy and self.position >= self.schedule.coarse_end and not exact
        weights = self.position >= self.schedule.rounding
        return Rounding(self.noise if noise else None, attributes=exact, weights=weights)

    def picture(self, index: int) -> TrainingView:
        """Training view `index` as the steps at this position see it: reduced at first if large."""
        return self.views.reduced(index, self.schedule.reduction(self.position, self.config.small_pictures))

    def measured_levels(self) -> list[int]:
        """The levels in which phases measure errors, ascending: level 0, if the run trains it, and the highest. Level 1
        below a level 2 needs no more than they do."""
        return sorted({self.model.level if self.config.rollout == "top" else 0, self.model.level})

    # -- measures --------------------------------------------------------------------------------------------------

    def active_anchors(self) -> list[int]:
        """Anchors active per level 0, 1, 2."""
        with torch.no_grad():
            return [int((self.model.masks(level) > MASK_THRESHOLD).sum()) for level in range(3)]

    def plane_bits(self) -> list[float]:
        """The bits of the planes of layers 1 and 2 if coded now: sums of R(a) in the groups of `--priors gauss`; 0 for
        an absent layer."""
        steps = self.model.steps.scaled(1.0)
        found = {i: f.planes.bits(steps.planes(i)) for i, f in self.model.deformations.items()}
        return [found.get(1, 0.0), found.get(2, 0.0)]

    def level_psnr(self, views: Sequence[View]) -> list[float]:
        """Per level of the model the mean mPSNR over `views`, dB, rounded as at this position, without noise."""
        rounding = self.rounding(noisy=False)
        return [level_psnr(self.model, level, views, rounding=rounding) for level in range(self.model.level + 1)]

    # -- changes ---------------------------------------------------------------------------------------------------

    def snapshot(self) -> tuple[Any, ...]:
        """Copies the parameters, their moments and the random state, for `return_to`."""
        values = {p: p.detach().clone() for p in self.optimiser.parameters}
        moments = {p: {n: m.clone() for n, m in own.items()} for p, own in self.optimiser.moments.items()}
        return values, moments, self.generator.get_state(), self.noise.generator.get_state(), list(self.order)

    @torch.no_grad()
    def return_to(self, before: tuple[Any, ...]) -> None:
        """Undoes all steps since a `snapshot`, which can be returned to again."""
        values, moments, generator, noise, order = before
        self.optimiser.moments = {p: {n: m.clone() for n, m in own.items()} for p, own in moments.items()}
        self.order = list(order)
        for parameter, value in values.items():
            parameter.copy_(value)
        self.generator.set_state(generator)
        self.noise.generator.set_state(noise)

    def keep_anchors(self, rows: Tensor) -> None:
        """Keeps only the anchors `rows` (int64)."""
        names = (*PER_ANCHOR, "anchor_q")
        self.replace_anchors(rows, {name: getattr(self.model, name).detach()[:0] for name in names})

    def replace_anchors(self, rows: Tensor, added: dict[str, Tensor]) -> None:
        """Keeps the anchors `rows` (int64) and appends those of `added`, by attribute."""
        self.optimiser.replace_anchors(rows, added)
        for name, value in self.statistics.items():
            new = value.new_zeros(len(added["anchor_q"]), *value.shape[1:])
            self.statistics[name] = torch.cat([value[rows.cpu()], new])

    # -- checkpoints -----------------------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """The state that a checkpoint holds besides the model, so that a resumed run continues alike."""
        return {
            "iteration": self.iteration,
            "total": self.schedule.iterations or 0,
            "share": self.share or 0.0,
            "passed": self._before,
            "rho": self.rho,
            "opened": self.opened,
            "placing": self.placing,
            "guided": self.guided,
            "skipped": self.skipped,
            "order": self.order,
            "exposures": {camera: exposure.detach() for camera, exposure in self.views.exposures.items()},
            "optimiser": self.optimiser.state(),
            "densifier": self.statistics,
            "generator": self.generator.get_state(),
            "noise": self.noise.generator.get_state(),
        }

    def restore(self, model: Model, state: dict[str, Any]) -> None:
        """Continues with `model` from a `state`. Raises an exception of any type if the state is broken."""
        if model.widths != self.model.widths:
            raise ValueError(f"the model has {model.widths}, expected {self.model.widths} as in its configuration")
        fresh = fresh_statistics(len(model.anchor_q), self.config.slots)
        for name, value in fresh.items():
            if state["densifier"][name].shape != value.shape:
                found, expected = tuple(state["densifier"][name].shape), tuple(value.shape)
                raise ValueError(f"{name} has shape {found}, expected {expected}")
        for name, most in (("iteration", MOST_STEPS), ("skipped", MOST_STEPS), ("total", MOST_STEPS), ("share", 1)):
            least = int(name == "total" and self.share is None)  # a timed run may not have estimated its total yet
            if not least <= state[name] <= most:
                raise ValueError(f"{name} is {state[name]!r}, expected a number from {least} to {most}")
        if not math.isfinite(state["rho"]):
            raise ValueError(f"rho is {state['rho']!r}, expected a finite number")
        for camera, exposure in self.views.exposures.items():
            if (stored := state["exposures"][camera]).shape != exposure.shape:
                raise ValueError(f"exposure has shape {tuple(stored.shape)}, expected {tuple(exposure.shape)}")
            exposure.data.copy_(stored)
        frozen = self.model.frozen
        for name in ("anchor_q", *PER_ANCHOR):
            if not torch.equal(getattr(model, name)[:frozen].to(self.device), getattr(self.model, name)[:frozen]):
                raise ValueError(f"{name} of the first {frozen} anchors is not that of the base")
        model.freeze(frozen)
        self.model = model.to(self.device)
        self.optimiser = Optimiser(self.model, self.config.rates, self.config.cooldown, self.views.exposures.values())
        self.optimiser.load_state(state["optimiser"])
        self.statistics = {name: state["densifier"][name].float() for name in fresh}
        self.generator.set_state(state["generator"])
        self.noise.generator.set_state(state["noise"])
        self.iteration, self.skipped = int(state["iteration"]), int(state["skipped"])
        self.schedule = Schedule(int(state["total"]) or None)
        if self.share is not None:
            self.share, self._before = float(state["share"]), int(state["passed"])
        self.rho, self.guided = float(state["rho"]), bool(state["guided"])
        self.opened, self.placing = bool(state["opened"]), bool(state["placing"])
        self.order = [int(index) for index in state["order"]]


def fresh_statistics(anchors: int, slots: int) -> dict[str, Tensor]:
    """Zeros, by name. pull, visits [N, slots]: sum of a Gaussian's image gradients, number of pictures that draw it.
    opacity, anchor_visits [N]: sum of an anchor's opacities, number of pictures that evaluate it."""
    shapes = {"pull": (anchors, slots), "visits": (anchors, slots), "opacity": (anchors,), "anchor_visits": (anchors,)}
    return {name: torch.zeros(shape) for name, shape in shapes.items()}
