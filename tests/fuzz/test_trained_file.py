"""A small file that training made: no flipped bit and no cut of it decodes."""

import pytest
from fuzzing import damage

from pd4dgs_codec import decode
from pd4dgs_codec.errors import DecodeError
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.scene import Steps


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """At most 4 kB with three layers."""
    from pd4dgs_codec.data.dataset import load
    from pd4dgs_codec.model.config import DeformationConfig, ModelConfig
    from pd4dgs_codec.model.convert import to_scene
    from pd4dgs_codec.train.config import TrainConfig
    from pd4dgs_codec.train.loop import Trainer

    size = ModelConfig(
        DeformationConfig(3, 3, 2, (1,), 4, ("position", "feature")),
        DeformationConfig(3, 4, 2, (1,), 4, ("mean", "color")),
        hidden=4,
        initial_anchors=24,
        max_anchors=28,
        steps=Steps(weights_scaffold=0.01, weights_global=0.004, weights_local=0.004),
    )
    source = "synthetic:local"
    config = TrainConfig(preset="tiny", source=source, iterations=120)
    trainer = Trainer(config, load(source, downscale=4), size=size)
    trainer.run(tmp_path_factory.mktemp("trained") / "model.pt")
    data = encode(to_scene(trainer.model), layers=2)
    assert 1500 < len(data) <= 4096
    assert decode(data).layers == (0, 1, 2)
    return data


@pytest.mark.slow
def test_every_flip_is_refused(data):
    for bit in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises(DecodeError):
            decode(bytes(flipped))


@pytest.mark.slow
def test_every_cut_is_refused_or_gives_whole_layers(data):
    ends = damage.chunk_ends(data)
    with damage.whole_payloads_known([data]) as originals:
        for size in range(len(data)):
            damage.check_cut(data, size, originals[data], ends)
