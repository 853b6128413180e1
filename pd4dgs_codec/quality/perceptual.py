"""LPIPS, ST-LPIPS and FLIP, each if its package and weights are installed; masked, and between successive pictures.

Nothing is downloaded. docs/evaluation.md gives the definitions and the sources of the packages.
"""

import functools
import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from pd4dgs_codec.errors import DataError, one_line
from pd4dgs_codec.quality.image import LEAST_WEIGHT, prepare

#: FLIP's default viewing conditions: metres from the screen, and the screen's width in pixels and in metres.
VIEWING = (0.7, 3840, 0.7)
#: Smallest side, pixels, for which the networks' strides and paddings leave an output.
LPIPS_LEAST, STLPIPS_LEAST = 31, 21

#: float32 [H, W] error per pixel, or one number for the picture, of two float32 [H, W, 3] in 0..1
ErrorMap = Callable[[np.ndarray, np.ndarray], np.ndarray]
#: The distances of `--perceptual`, and the distance of the protocol 3dgs.
PERCEPTUAL, VGG = ("lpips", "stlpips", "flip"), "lpips_vgg"


@dataclass(frozen=True)
class Distance:
    """One perceptual distance: 0 for equal pictures, larger is worse.

    title: for tables. source: package, version and network. least: smallest side of a picture, pixels.
    """

    title: str
    source: str
    error_map: ErrorMap
    least: int = 1

    def __call__(self, pred: np.ndarray, target: np.ndarray, mask: np.ndarray | None = None) -> float:
        """Returns sum(map * m) / max(sum(m), 1e-6), where map compares pred * m and target * m, as DyCheck's mLPIPS.

        pred, target: [H, W, 3] uint8 or floats in 0..1, brought to 8 bits first. mask: bool [H, W]; None = all.
        Raises DataError if shapes differ or the picture is smaller than `least`.
        """
        a, b, m = prepare(pred, target, mask)
        height, width = m.shape
        if min(height, width) < self.least:
            raise DataError(f"image is {width}x{height}, expected at least {self.least}x{self.least} for {self.title}")
        masked = [np.ascontiguousarray(z * m[..., None], dtype=np.float32) for z in (a, b)]
        return float((self.error_map(*masked) * m).sum() / max(m.sum(), LEAST_WEIGHT))

    def temporal(self, frames: Iterable[np.ndarray]) -> float:
        """Returns the mean unmasked distance of successive frames [H, W, 3]. Raises DataError for fewer than two."""
        distances = [self(later, earlier) for earlier, later in pairwise(frames)]
        if not distances:
            raise DataError(f"expected at least 2 frames for {self.title} over time")
        return float(np.mean(distances))


@dataclass(frozen=True)
class Perceptual:
    """distances: available distances by name. absent: the reason for each distance that is not available."""

    distances: dict[str, Distance]
    absent: dict[str, str]


class _Absent(Exception):
    """The reason why a distance is not available."""


def load_perceptual(names: Iterable[str] = PERCEPTUAL) -> Perceptual:
    """Loads the distances `names` that are installed; this takes a second or two."""
    loaders: dict[str, Callable[[], Distance]] = {
        "lpips": lambda: _lpips("LPIPS", "alex", "AlexNet_Weights", spatial=True),
        "stlpips": _stlpips,
        "flip": _flip,
        # as 3D Gaussian Splatting's code calls it: one number, and pictures in 0..1 although the network expects -1..1
        VGG: lambda: _lpips("LPIPS-VGG", "vgg", "VGG16_Weights", spatial=False, low=0.0),
    }
    distances, absent = {}, {}
    for name in names:
        try:
            distances[name] = loaders[name]()
        except _Absent as error:
            absent[name] = str(error)
        except ModuleNotFoundError as error:
            absent[name] = f"the module {error.name} is not installed"
        except Exception as error:  # a broken package must not disable the other distances
            absent[name] = one_line(f"{type(error).__name__}: {error}")
    return Perceptual(distances, absent)


def _lpips(title: str, net: str, weights: str, *, spatial: bool, low: float = -1.0) -> Distance:
    """Returns LPIPS by a network whose ImageNet weights torchvision describes as `weights`. low: see `_of_network`."""
    import torch
    from torchvision import models

    # lpips would make torchvision download weights that are not in this folder
    file = Path(torch.hub.get_dir()) / "checkpoints" / Path(getattr(models, weights).IMAGENET1K_V1.url).name
    if not file.is_file():
        raise _Absent(f"its ImageNet weights are not in {file}")
    import lpips

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a deprecation of torchvision
        network = lpips.LPIPS(net=net, spatial=spatial, verbose=False)
    return Distance(title, f"lpips {metadata.version('lpips')}, {net}", _of_network(network, low), LPIPS_LEAST)


def _stlpips() -> Distance:
    # The package imports these modules but does not use them for the shift-tolerant AlexNet. sys.modules is restored,
    # so that no other code gets the stand-ins; torch must not be imported a second time after that.
    from unittest import mock  # importing it takes a tenth of a second

    import torch  # noqa: F401

    names = {"torchvision": "models", "IPython": "embed", "torchsummary": "summary"}
    unused = {module: SimpleNamespace(**{name: None}) for module, name in names.items()}
    with mock.patch.dict(sys.modules, unused):
        from stlpips_pytorch import stlpips
    network = stlpips.LPIPS(net="alex", variant="shift_tolerant", spatial=True, verbose=False)
    source = f"stlpips-pytorch {metadata.version('stlpips-pytorch')}, alex, shift tolerant"
    return Distance("ST-LPIPS", source, _of_network(network), STLPIPS_LEAST)


def _of_network(network: Any, low: float = -1.0) -> ErrorMap:
    """Returns the error map of an LPIPS-like module, whose inputs are [1, 3, H, W] in low..1."""
    import torch

    @torch.inference_mode()
    def error_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        x, y = (torch.from_numpy(z).permute(2, 0, 1)[None] * (1 - low) + low for z in (a, b))
        distances: np.ndarray = network(x, y)[0, 0].numpy()
        return distances

    return error_map


def _flip() -> Distance:
    import flip_evaluator

    evaluate = functools.partial(
        flip_evaluator.evaluate,
        dynamicRangeString="LDR",
        applyMagma=False,
        computeMeanError=False,
        parameters={"vc": list(VIEWING)},
    )

    def error_map(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        distances: np.ndarray = evaluate(b, a)[0][..., 0]
        return distances

    return Distance("FLIP", f"flip-evaluator {metadata.version('flip-evaluator')}", error_map)
