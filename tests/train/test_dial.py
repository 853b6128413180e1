"""The one dial: what it costs is monotone over its range, on a run of seconds; docs/training.md has what it shows."""

import pytest
from runs import records_of, trainer_of
from trainer_rate import train_rate_bits

from pd4dgs_codec.format.encoder import encode_with_report
from pd4dgs_codec.model.model import to_scene
from pd4dgs_codec.quality.measure import level_psnr
from pd4dgs_codec.train.config import at_quality


@pytest.mark.usefixtures("short_runs_have_phases")
def test_bytes_rise_with_the_dial(dataset, tmp_path):
    files, sizes, psnr = [], [], []
    for quality in (0, 100):
        trainer = trainer_of(dataset, 60, **at_quality(quality))
        trainer.run(tmp_path / "m.pt")
        model = trainer.model
        psnr.append(level_psnr(model, 2, dataset.train))
        data, report = encode_with_report(to_scene(model), effort=1, omit="nothing")
        streams = [stream for layer in report.layers for stream in layer.streams]
        files.append(len(data))
        sizes.append(sum(stream.payload_bits for stream in streams if stream.name != "weights"))
    assert sizes[0] < 0.9 * sizes[1]
    assert files == sorted(files)  # of which weights, that the dial leaves alone, are more than half
    assert max(psnr) - min(psnr) < 0.5, psnr  # so short a run learns little that the dial could take


def test_what_is_coded_of_planes_is_what_the_log_says(dataset, tmp_path):
    """The trainer's own sum of R(a) of the planes, at the end of a run, is the encoder's within 2 %."""
    trainer = trainer_of(dataset, 40, plane_rate=1e-6)
    records = records_of(trainer, tmp_path)
    logged = records[-1]
    assert {"global_rate_proxy", "local_rate_proxy"} <= set().union(*records)  # logged apart
    scene = to_scene(trainer.model)
    _, report = encode_with_report(scene, priors="gauss", effort=1, omit="nothing", layers=2)
    for own, row in zip(train_rate_bits(scene), report.layers, strict=True):
        if row.layer:
            (coded,) = (s.rate_bits for s in row.streams if s.name == "planes")
            assert logged["plane_bits"][row.layer - 1] == pytest.approx(coded, rel=0.02)
            assert own["planes"] == pytest.approx(coded, rel=0.02)
