"""What a training run is: frozen settings and the schedule they imply. Source of the constants: the PD-4DGS method."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

from pd4dgs_codec.errors import TrainError
from pd4dgs_codec.scene import MAX_FEATURE, MAX_SLOTS, Steps, Widths

#: Iterations per preset when neither a count nor a time limit is given.
DEFAULT_ITERATIONS = {"tiny": 3_000, "small": 10_000, "paper": 15_000}

#: Which levels a step trains after the coarse phase: one drawn from pi(rho), from the uniform or from the paper's fixed
#: distribution; the highest alone, as a monolithic model is trained; or each of them, with a view of its own, at thrice
#: the cost.
ROLLOUTS = ("adaptive", "uniform", "fixed", "top", "all")

#: Share of a run in which level 0 alone is trained.
COARSE_SHARE = 1 / 10

#: Rounds in which anchors that the pictures hardly need are taken out; each anchor may leave in one of them.
PRUNING_ROUNDS = 4

#: Parts of the method that an ablation takes out, as the fields of `TrainConfig` that do so.
ABLATIONS: dict[str, dict[str, Any]] = {
    "rate": {"rate_scale": 0.0, "plane_rate": 0.0},
    "planes": {"plane_rate": 0.0},
    "binary": {"tmc_binary": False},
    "smooth": {"tmc_smooth": False},
    "tmc": {"tmc_binary": False, "tmc_smooth": False},
    "noise": {"noise": False},
    "whitening": {"whitening": False},
    "judge": {"judge": False},
}

#: What the dial moves, as (value at 50, factor from there to 0). From 100 to 50 it is the same factor, so that each is
#: log-linear in the quality: fields of `TrainConfig`.
DIAL: dict[str, tuple[float, float]] = {
    "rate_scale": (0.08, 4.0),
    "plane_rate": (4e-9, 4.0),
    "prune": (0.14, 3.0),
    "step_scale": (1.16, 1.6),
    "grading": (0.05, 3.0),
}

#: The steps that `step_scale` multiplies. Offsets and weights cost more quality per byte than any of these.
COARSENED = ("feature", "scaling_log", "planes_global", "planes_local")

#: What checkpoints that lack these fields were trained with, where it is not what has become their default.
BEFORE: dict[str, Any] = {
    "judge": False,
    "tmc_binary_growth": 1.0,
    "prune": 0.0,
    "cooldown": 0.0,
    "plane_rate": 0.0,
    "step_scale": 1.0,
    "feature_width": 32,
    "slots": 10,
    "grading": 0.0,
    "whitening": False,
    "views_per_step": 1,
}


def at_quality(quality: float) -> dict[str, float]:
    """The fields of `TrainConfig` that a quality of 0..100 stands for: weights of the rates, pruning, steps."""
    if not 0 <= quality <= 100:
        raise TrainError(f"quality must be from 0 to 100, found {quality:g}")
    return {name: middle * factor ** ((50 - quality) / 50) for name, (middle, factor) in DIAL.items()}


#: The middle of the dial; docs/levers.md has what other points give.
DEFAULT_QUALITY = 50.0
_DEFAULT = at_quality(DEFAULT_QUALITY)


@dataclass(frozen=True)
class LearningRates:
    """(start, end) of a log-linear schedule over the run, which `TrainConfig.cooldown` takes down to 0 besides; Adam,
    eps 1e-15. The ends are high: what is learnt by then is learnt faster, and the cooldown settles it."""

    feature: tuple[float, float] = (7.5e-3, 1.2e-2)
    scaling_log: tuple[float, float] = (7e-3, 1.2e-2)
    offset: tuple[float, float] = (1e-2, 1.6e-3)
    mask_logits: tuple[float, float] = (5e-2, 0.16)
    opacity: tuple[float, float] = (2e-3, 8e-4)
    covariance: tuple[float, float] = (4e-3, 3.2e-3)
    color: tuple[float, float] = (8e-3, 1.6e-3)
    planes: tuple[float, float] = (3e-2, 8e-3)
    deformation: tuple[float, float] = (1.5e-3, 5.6e-4)


@dataclass(frozen=True)
class PlaneWeights:
    """Weights of the plane regularisers: spatial second difference, its time twin, mean |1 - g| of the time planes."""

    plane_smooth: float
    time_smooth: float
    time_l1: float


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides a run besides the data. Each ablation of the method is one field."""

    preset: str = "small"
    source: str = ""  #: what `data.load` was given; stored so that a resumed run meets the same data
    feature_width: int = 32  #: numbers of an anchor's feature
    slots: int = 10  #: Gaussians of an anchor
    downscale: int = 1
    holdout: int = 8
    iterations: int | None = None  #: None: the preset's default, or by the clock if there is a limit
    max_seconds: float | None = None  #: without `iterations` the whole schedule is spread over it, else it cuts the run
    seed: int = 0
    lambdas: tuple[float, float, float] = (0.04, 0.01, 0.00025)  #: rate weight per level
    rate_scale: float = _DEFAULT["rate_scale"]  #: multiplies every lambda; 1 is the paper's operating point
    rate_share: float = 0.05  #: share of the anchors on which a step estimates the rate
    plane_rate: float = _DEFAULT["plane_rate"]  #: weight of a bit of the planes, ramped by `Schedule.pressure`
    tmc: float = 0.01
    tmc_binary: bool = True
    #: the binary term's weight grows to so many times its start, so that masks end near 0 or 1: an anchor that stays
    #: half visible at a level is paid for in full there
    tmc_binary_growth: float = 20.0
    tmc_smooth: bool = True
    tmc_tau: float = 4.0  #: voxels
    #: views of each level that a step trains; their gradients are averaged, and several workers share them
    views_per_step: int = 1
    rollout: str = "adaptive"  #: one of ROLLOUTS
    #: layers above it are not there: 0 is a static scaffold, 1 a scaffold and its global deformation
    max_layer: int = 2
    judge: bool = True  #: leave out levels that gain nothing on training views not seen yet, see `judge`
    #: where growing ends, anchors leave whose absence adds this share at most to the squared error; see `pruning`
    prune: float = _DEFAULT["prune"]
    #: share that coarser steps of single anchors add at most to the squared error where planes begin to be rounded; 0:
    #: all anchors keep the steps; see `grading`
    grading: float = _DEFAULT["grading"]
    whitening: bool = True  #: where planes begin to be rounded, mix the features' channels; see `whitening`
    #: share of the last third's steps that see the most useful anchors of level 0 alone; see `prefixes`
    prefixes: float = 0.0
    #: share of the run, at its end, over which all learning rates fall to 0 besides: else the last steps carry weights
    #: over the edges of their rounding intervals, and pictures change by tenths of a dB from one step to the next
    cooldown: float = 0.4
    ssim: float = 0.2
    volume: float = 0.01  #: weight of the mean product of scales (Scaffold-GS)
    noise: bool = True  #: imitate quantisation: noise on attributes, rounding of planes and weights, at last of all
    grow_threshold: float = 2e-4
    steps: Steps | None = None  #: None: the preset's
    step_scale: float = _DEFAULT["step_scale"]  #: multiplies the steps of features, log-scalings and planes
    rates: LearningRates = field(default_factory=LearningRates)
    global_planes: PlaneWeights = PlaneWeights(1e-4, 5e-4, 5e-5)
    local_planes: PlaneWeights = PlaneWeights(2e-4, 1e-3, 1e-4)
    max_gradient_norm: float = 100.0

    @property
    def widths(self) -> Widths:
        """Of a fresh model's anchors."""
        return Widths(self.feature_width, self.slots)

    def model_steps(self, preset: Steps) -> Steps:
        """The steps of a fresh model whose preset has these; `step_scale` moves those that bytes depend on and pictures
        hardly do."""
        steps = self.steps or preset
        coarser = {name: getattr(steps, name) * self.step_scale for name in COARSENED}
        return replace(steps, **coarser)

    def __post_init__(self) -> None:
        if self.preset not in DEFAULT_ITERATIONS:
            raise TrainError(f"preset {self.preset!r} is unknown; expected one of {', '.join(DEFAULT_ITERATIONS)}")
        if self.iterations is not None and self.iterations < 1:
            raise TrainError(f"iterations must be at least 1, found {self.iterations}")
        if self.max_seconds is not None and not self.max_seconds > 0:
            raise TrainError(f"max-seconds must be positive, found {self.max_seconds}")
        if not 0 <= self.seed <= 2**63 - 2:  # the next one seeds the noise
            raise TrainError(f"seed {self.seed} is out of range; expected an integer from 0 to 2^63 - 2")
        if self.views_per_step < 1:
            raise TrainError(f"views_per_step must be at least 1, found {self.views_per_step}")
        for name, limit in (("feature_width", MAX_FEATURE), ("slots", MAX_SLOTS)):
            if not 1 <= getattr(self, name) <= limit:
                raise TrainError(f"{name} must be from 1 to {limit}, found {getattr(self, name)}")
        for name in ("rate_scale", "plane_rate"):
            if not 0 <= getattr(self, name) < math.inf:
                raise TrainError(f"{name} must be 0 or more and finite, found {getattr(self, name)}")
        if not 0 < self.step_scale < math.inf:
            raise TrainError(f"step_scale must be positive and finite, found {self.step_scale}")
        for name in ("prune", "cooldown", "grading", "prefixes"):
            if not 0 <= getattr(self, name) <= 1:
                raise TrainError(f"{name} must be from 0 to 1, found {getattr(self, name)}")
        if self.rollout not in ROLLOUTS:
            raise TrainError(f"rollout {self.rollout!r} is unknown; expected one of {', '.join(ROLLOUTS)}")
        if self.max_layer not in (0, 1, 2):
            raise TrainError(f"max-layer must be 0, 1 or 2, found {self.max_layer}")


@dataclass(frozen=True)
class Schedule:
    """The phases of a run of N iterations, as fractions of N (the paper's N is 30,000).

    iterations: N; None where a time limit fixes it, but has not yet. Such a run stays in its coarse phase: every later
    one begins at infinity, and nothing is grown or pruned. Whole numbers otherwise.
    """

    iterations: int | None

    def _at(self, fraction: float) -> float:
        return math.inf if self.iterations is None else round(self.iterations * fraction)

    def progress(self, iteration: int) -> float:
        """The share of the run, 0..1, that lies before `iteration`; 0 while N is not known."""
        return iteration / self.iterations if self.iterations else 0.0

    @property
    def coarse_end(self) -> float:
        """Before it only level 0 is trained; from it on, quantisation noise is added."""
        return self._at(COARSE_SHARE)

    @property
    def warm(self) -> float:
        """The method samples levels uniformly before it (T_warm). Here it ends within the coarse phase, and rho_start,
        never earlier, decides."""
        return self._at(1 / 15)

    @property
    def progressive(self) -> float:
        """The rate term, TMC and the average rho start here (T_progressive)."""
        return self._at(1 / 3)

    @property
    def rho_start(self) -> float:
        """rho's moving average starts here."""
        return max(self.warm, self.progressive)

    @property
    def rho_every(self) -> float:
        """Iterations between updates of rho (K)."""
        return max(1, self._at(1 / 150))

    @property
    def grow(self) -> range:
        """Iterations after which anchors are grown and pruned."""
        if self.iterations is None:
            return range(0)
        every = max(20, round(self.iterations * (1 / 100)))
        return range(round(self.iterations * (1 / 60)) + every, round(self.iterations * (1 / 2)) + 1, every)

    @property
    def prune(self) -> range:
        """Iterations before which anchors that the pictures hardly need are taken out: growing has ended."""
        if self.iterations is None:
            return range(0)
        every = max(1, round(self.iterations * (1 / 50)))
        return range(self.grow.stop, self.grow.stop + PRUNING_ROUNDS * every, every)

    @property
    def rounding(self) -> float:
        """Planes and weights are rounded straight-through from here on."""
        return self._at(2 / 3)

    @property
    def exact_rounding(self) -> float:
        """The anchors' attributes are rounded straight-through from here on, where noise imitated it before."""
        return self._at(9 / 10)

    def separation(self, iteration: int) -> float:
        """How far the masks' separation has gone, 0..1: it begins with the mask terms and ends with exact rounding."""
        return self._since_progressive(iteration, self.exact_rounding)

    def pressure(self, iteration: int) -> float:
        """How much of the planes' rate weighs, 0..1: it begins with the rate term and is all there where planes are
        rounded. All of it at once empties planes before they have learnt anything."""
        return self._since_progressive(iteration, self.rounding)

    def _since_progressive(self, iteration: int, end: float) -> float:
        """The share of the way from there to `end`, 0..1."""
        if self.iterations is None:
            return 0.0
        begin = self.progressive
        return min(max((iteration - begin) / max(1, end - begin), 0.0), 1.0)

    def phases_not_reached(self, iteration: int) -> list[str]:
        """Names of the phases that a run cut after `iteration` iterations never entered; none for a whole run."""
        if self.iterations is not None and iteration >= self.iterations:
            return []
        starts = {
            "levels 1 and 2": self.coarse_end,
            "rate and mask terms": self.progressive,
            "rounding of planes and weights": self.rounding,
            "exact rounding of attributes": self.exact_rounding,
            "the end of the learning-rate schedule": self._at(1) - 1,
        }
        return [name for name, start in starts.items() if iteration <= start]


def learning_rate(bounds: tuple[float, float], progress: float, cooldown: float = 0.0) -> float:
    """Log-linear between the bounds at progress 0..1; over the last `cooldown` of it, times what falls from 1 to 0."""
    start, end = bounds
    progress = min(max(progress, 0.0), 1.0)
    left = min((1 - progress) / cooldown, 1.0) if cooldown else 1.0
    return start * math.pow(end / start, progress) * left
