"""The options of a training run, after the PD-4DGS method.

`option` declares the default, help text, range and quality-dial factor of a field of `TrainConfig` in one place. The
command line, the checks and resuming read these declarations.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from pd4dgs_codec.errors import TrainError, one_line
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.scene import MAX_FEATURE, MAX_SLOTS, Steps, Widths

#: Which levels a step trains after the coarse phase. key: mostly the highest, see `rollout`. adaptive, uniform, fixed:
#: a level drawn from pi(rho), from the uniform distribution or from the paper's fixed one. top: the highest level, as a
#: monolithic model is trained. all: every level, each with its own view, at three times the cost.
ROLLOUTS = ("key", "adaptive", "uniform", "fixed", "top", "all")

#: Which of the scaffold's networks take the view direction.
VIEW_DEPENDENT = ("color", "covariance+color", "opacity+color", "opacity+covariance+color")

#: Parts of the method that `--without` turns off, with the fields of `TrainConfig` that it sets.
ABLATIONS: dict[str, dict[str, Any]] = {
    "rate": {"rate_scale": 0.0, "plane_rate": 0.0},
    "planes": {"plane_rate": 0.0},
    "binary": {"binary": 0.0},
    "noise": {"noise": False},
    "whitening": {"whitening": False},
}

#: The quantisation steps that `step_scale` multiplies. Coarser offsets and weights cost more quality per byte saved.
COARSENED = ("feature", "scaling_log", "planes_global", "planes_local")


@dataclass(frozen=True)
class Option:
    """The declaration of a field of `TrainConfig`, besides its type and default.

    help, metavar: texts of the generated command-line option; without help, none is generated.
    least, most: inclusive bounds of a number; above: an exclusive lower bound.
    count: how many numbers the value holds, as a tuple if more than one.
    choices: all allowed values; if empty, the bounds apply.
    dial: ratio of the value at quality 0 to the default (quality 50); None if the dial does not set the field.
    fixed: a resumed run takes the value from its checkpoint, and the command line may not contradict it.
    """

    help: str = ""
    metavar: str = "X"
    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    count: int = 1
    choices: tuple[Any, ...] = ()
    dial: float | None = None
    fixed: bool = True

    @property
    def range(self) -> str:
        """The allowed values, in words."""
        if self.choices:
            return f"one of {', '.join(map(str, self.choices))}"
        if self.above > -math.inf:
            return f"more than {self.above:g}"
        return f"at least {self.least:g}" if self.most == math.inf else f"from {self.least:g} to {self.most:g}"

    def check(self, name: str, value: Any) -> None:
        """Raises TrainError for a value out of range. None, the default of optional fields, passes."""
        allowed = value in self.choices if self.choices else value is None or self.contains(value)
        if not allowed:
            raise TrainError(f"{name} must be {self.range}, found {value}")

    def contains(self, value: Any) -> bool:
        """Whether the number, or each of a tuple of `count` numbers, is finite and within the bounds."""
        if self.count > 1:
            one = replace(self, count=1)
            return isinstance(value, tuple) and len(value) == self.count and all(map(one.contains, value))
        return self.least <= value <= self.most and value > self.above and math.isfinite(value)


def option(default: Any, **about: Any) -> Any:
    """Declares a field of `TrainConfig` by its default and the fields of its `Option`."""
    return field(default=default, metadata={"option": Option(**about)})


#: That a checkpoint may count.
MOST_STEPS = 2_000_000_000
#: Steps up to which a run uses the deformation rates of `LearningRates` unchanged.
SHORT_RUN = 1500


@dataclass(frozen=True)
class LearningRates:
    """Adam's learning rates by parameter group: (start, end) of a log-linear schedule over the run.

    Final rates stay high because `TrainConfig.cooldown` anneals them to 0. `planes` and `deformation` apply to runs of
    up to SHORT_RUN steps; `of_run` scales them for longer runs. Log-scalings have those of features, exposures those of
    the opacity network.
    """

    feature: tuple[float, float] = (7.5e-3, 1.2e-2)
    offset: tuple[float, float] = (1e-2, 1.6e-3)
    mask_logits: tuple[float, float] = (5e-2, 0.16)
    opacity: tuple[float, float] = (2e-3, 8e-4)
    covariance: tuple[float, float] = (4e-3, 3.2e-3)
    color: tuple[float, float] = (8e-3, 1.6e-3)
    planes: tuple[float, float] = (3e-2, 8e-3)
    deformation: tuple[float, float] = (1.5e-3, 5.6e-4)

    @property
    def scaling_log(self) -> tuple[float, float]:
        return self.feature

    @property
    def exposure(self) -> tuple[float, float]:
        return self.opacity

    def of_run(self, iterations: int | None) -> LearningRates:
        """The rates of a run of `iterations` steps. Beyond SHORT_RUN, the end rates of planes and deformation fall as
        1/iterations and the start rate of planes as 1/sqrt(iterations), so that long runs settle."""
        share = min(SHORT_RUN / iterations, 1.0) if iterations else 1.0
        planes = self.planes[0] * math.sqrt(share), self.planes[1] * share
        return replace(self, planes=planes, deformation=(self.deformation[0], self.deformation[1] * share))


@dataclass(frozen=True)
class PlaneWeights:
    """Weights of the plane regularisers: second differences in space and in time, mean |1 - g| of the time planes."""

    plane_smooth: float
    time_smooth: float
    time_l1: float


#: The steps of each preset, for the help.
_STEPS = ", ".join(f"{name} {size.iterations:,}" for name, size in PRESETS.items())


@dataclass(frozen=True)
class TrainConfig:
    """The configuration of a run, without its data. Raises TrainError for a value out of its option's range."""

    preset: str = option("small", help="model size", choices=tuple(PRESETS))
    source: str = ""  #: the source given to `data.load`, stored so that a resumed run reads the same data
    feature_width: int = option(
        32, help=f"feature channels per anchor, 1 to {MAX_FEATURE}", metavar="N", least=1, most=MAX_FEATURE
    )
    slots: int = option(10, help=f"Gaussians per anchor, 1 to {MAX_SLOTS}", metavar="N", least=1, most=MAX_SLOTS)
    view_dependent: str = option("color", help="networks that take the view direction", choices=VIEW_DEPENDENT)
    downscale: int = option(1)
    holdout: int = option(8)
    #: of pictures whose times are numbers of frames; None: the dataset's, or 30
    fps: float | None = option(
        None, help="frames per second of numbered pictures (default: 30)", metavar="F", least=0.01, most=1000
    )
    #: RGB of the scene's background and behind pictures with alpha; None: see `dataset.load`
    background: tuple[float, float, float] | None = option(None, least=0, most=1, count=3)
    #: None: the preset's default, or as many as `max_seconds` allows
    iterations: int | None = option(
        None,
        help=f"training steps (default: {_STEPS}; what --max-seconds allows)",
        metavar="N",
        least=1,
        most=MOST_STEPS,
    )
    #: without `iterations`, the schedule is spread over this time; with `iterations`, the limit stops the run early
    max_seconds: float | None = option(
        None, help="training time in seconds, including the time before --resume", metavar="S", above=0, fixed=False
    )
    seed: int = option(0, help="random seed", metavar="N", least=0, most=2**63 - 2)
    #: rate weight per level; the paper's weight of level 2 is 0.00025, for anchors that only layer 2 has
    lambdas: tuple[float, float, float] = (0.04, 0.01, 0.01)
    #: multiplies every lambda; 1 is the paper's operating point
    rate_scale: float = option(0.08, help="weight of the anchors' bitrate; the paper's is 1", least=0, dial=4.0)
    rate_share: float = 0.05  #: share of the anchors from which a step estimates the rate
    plane_rate: float = option(4e-9, least=0, dial=4.0, fixed=False)  #: weight per bit of the planes, ramped up
    binary: float = 0.01  #: weight at first of the term that moves masks towards 0 or 1
    #: that weight grows to this multiple of its start: a half-visible anchor costs all its bytes
    binary_growth: float = 20.0
    #: the gradients of a step's views are averaged; workers share the views
    views_per_step: int = option(
        1, help="views per step and level, shared by the workers of torchrun", metavar="V", least=1
    )
    #: steps on smaller pictures cost less, and coarse structure is learnt before detail
    small_pictures: float = option(
        0.4,
        help="fraction of the run, from its start, that uses images of 400 pixels a side or more at a quarter, then "
        "half size; 0: off",
        least=0,
        most=1,
    )
    rollout: str = option("key", help="choice of the level to train in each step, see below", choices=ROLLOUTS)
    key_instant: float = option(
        0.5, help="normalised time that level 0 shows with --rollout key", metavar="T", least=0, most=1
    )
    #: 0 is the scene at one instant, 1 has its motion
    max_layer: int = option(2, help="highest layer to train", choices=(0, 1, 2))
    keep_layers: bool = option(
        False, help="keep layers even if they gain little on training views held back for this decision"
    )
    prune: float = option(
        0.3,
        help="prune anchors halfway through the run, adding at most this fraction to the squared error; 0: none",
        least=0,
        most=1,
        dial=3.0,
    )
    grading: float = option(
        0.05,
        help="coarser steps for less visible anchors, adding at most this fraction to the squared error; 0: none",
        least=0,
        most=1,
        dial=3.0,
    )
    whitening: bool = True  #: transform the channels of the features, see `phases.quantisation`
    #: share of the run, at its end, over which all learning rates fall to 0: otherwise the last steps move weights
    #: across rounding boundaries, and the PSNR jumps by tenths of a dB from one step to the next
    cooldown: float = option(0.4, least=0, most=1, fixed=False)
    ssim: float = 0.2
    volume: float = 0.01  #: weight of the mean product of scales (Scaffold-GS)
    noise: bool = True  #: simulate quantisation: noise on attributes, rounding of planes and weights, finally of all
    #: anchors grow where the mean image gradient of a Gaussian exceeds this, see `phases.grow`
    grow_threshold: float = option(2e-4, above=0, dial=2.0, fixed=False)
    #: multiplies the steps of features, log-scalings and planes
    step_scale: float = option(1.16, above=0, dial=1.6, fixed=False)
    rates: LearningRates = field(default_factory=LearningRates)
    planes: PlaneWeights = PlaneWeights(1e-4, 5e-4, 5e-5)
    max_gradient_norm: float = 100.0

    def __post_init__(self) -> None:
        for name, about in OPTIONS.items():
            about.check(name, getattr(self, name))

    @property
    def widths(self) -> Widths:
        """The widths of a fresh model's anchors."""
        return Widths(self.feature_width, self.slots, viewing=tuple(self.view_dependent.split("+")))

    @property
    def total(self) -> int | None:
        """N of the schedule; None in a timed run, which estimates it."""
        if self.iterations is None and self.max_seconds is None:
            return PRESETS[self.preset].iterations
        return self.iterations

    def model_steps(self, steps: Steps) -> Steps:
        """The preset's `steps` with the steps named in COARSENED multiplied by `step_scale`."""
        return replace(steps, **{name: getattr(steps, name) * self.step_scale for name in COARSENED})

    def to_json(self) -> str:
        """The configuration as checkpoints store it."""
        return json.dumps(self, default=vars)

    @classmethod
    def from_json(cls, text: str, path: str) -> TrainConfig:
        """The inverse of `to_json`. Raises TrainError naming the checkpoint `path` if `text` holds no configuration."""
        try:
            config: TrainConfig = _rebuilt(json.loads(text), TrainConfig())
            return config
        except (ValueError, TypeError, AttributeError, RecursionError, OverflowError) as error:
            reason = one_line(str(error), 160)
            raise TrainError(f"{path}: its stored configuration cannot be read: {reason}") from None


#: The `Option` of each declared field of `TrainConfig`.
OPTIONS: dict[str, Option] = {f.name: f.metadata["option"] for f in fields(TrainConfig) if "option" in f.metadata}
#: Fields that a resumed run takes from its checkpoint; the command line may not contradict them.
FIXED = tuple(name for name, about in OPTIONS.items() if about.fixed)
#: The fields that the quality dial sets: (value at quality 50, ratio of the value at quality 0 to it).
DIAL = {name: (getattr(TrainConfig, name), about.dial) for name, about in OPTIONS.items() if about.dial is not None}


def at_quality(quality: float) -> dict[str, float]:
    """The values of the fields in DIAL at a quality of 0..100, log-linear. Raises TrainError for another quality."""
    if not 0 <= quality <= 100:
        raise TrainError(f"quality must be from 0 to 100, found {quality:g}")
    return {name: middle * factor ** ((50 - quality) / 50) for name, (middle, factor) in DIAL.items()}


def _rebuilt(plain: Any, like: Any) -> Any:
    """Converts JSON data to the type of `like`: nested dataclasses, and tuples for lists. Raises ValueError, TypeError,
    AttributeError or OverflowError."""
    if is_dataclass(like) and not isinstance(like, type):
        return type(like)(**{name: _rebuilt(value, getattr(like, name)) for name, value in plain.items()})
    if like is None and plain is None:
        return None
    if isinstance(plain, list) and (like is None or isinstance(like, tuple) and len(plain) == len(like)):
        return tuple(_rebuilt(value, 0.0) for value in plain)
    kind = (int, float) if like is None or isinstance(like, float) else type(like)
    fits = isinstance(plain, kind) and isinstance(plain, bool) == isinstance(like, bool)  # True is an int
    if not fits or isinstance(plain, (int, float)) and not math.isfinite(plain):
        raise ValueError(f"found {plain!r}, expected a value like {like!r}")
    return plain
