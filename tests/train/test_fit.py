"""The motion of a segment, which is fitted to that of the whole before pictures train it."""

from dataclasses import replace

import numpy as np
import torch
from tiny import TINY, disc, trained_like_scene

from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.metadata import Metadata
from pd4dgs_codec.format.reader import read_base
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.train import segmented
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.segmented import base_of, continued, encoded


@torch.no_grad()
def moves(model, points, start, end):
    """[7, n, 3], in voxels: how far points are moved from a normalised time to another."""
    found = [model.moved_points(points, model.level, t) - points for t in np.linspace(start, end, 7)]
    return torch.stack(found) / model.info.voxel_size


def test_a_segment_starts_with_the_motion_of_the_whole_as_its_file_holds_it(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    data = encoded(from_scene(trained_like_scene()), None, Metadata())
    whole = decode(data)
    old = from_scene(whole)
    wanted = moves(old, old.anchor, 0.25, 0.5)  # 0.5 to 1 s of 2
    dataset, apart = replace(disc(), time_range=(0.5, 1.0)), list[float]()
    for steps in (0, 100):
        monkeypatch.setattr(segmented, "FITTING", steps)
        model = continued(TrainConfig(preset="tiny"), dataset, whole)
        found = moves(model, old.anchor, 0.0, 1.0)
        apart.append(float((found - wanted).square().mean().sqrt()))
    assert apart[0] > 0.5 and apart[1] < apart[0] / 3
    file = encoded(model, (read_base(data), whole.prefix(0)), Metadata())
    held = from_scene(decode(file, base=base_of(data)))
    assert torch.equal(moves(held, old.anchor, 0.0, 1.0), found)  # rounded: pictures train what is written
