"""A long capture trained as a folder: a whole, its layer 0 as the base, and segments that continue it."""

import json
import os
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
import refdec
from tiny import TINY

from pd4dgs_codec import decode
from pd4dgs_codec.format.info import hashes
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.scene import ATTRIBUTES
from pd4dgs_codec.segments import INDEX, read_index
from pd4dgs_codec.train import segmented
from pd4dgs_codec.train.learner import Learner

SOURCE = "synthetic:local?seconds=4&frames=17&size=32x24"
STEPS, EACH = 24, 2  #: of the whole, of a segment
NODE = shutil.which("node")
PLAYER = Path(__file__).parents[2] / "player" / "cli.mjs"


@pytest.fixture(autouse=True)
def _small_preset(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    monkeypatch.setattr(segmented, "FITTING", 20)


@pytest.fixture
def train(cli):
    def call(output, *options, source=SOURCE, segments=2):
        some = ("--segments", segments, "--preset", "tiny", "--iterations", STEPS, "-j", 1, "--json")
        return cli("train", source, "-o", output, *some, *options)

    return call


def parts(folder):
    """The base, and the bytes of each segment."""
    _, index = read_index(folder)
    return (folder / index.bases[0].file).read_bytes(), [(folder / s.file).read_bytes() for s in index.segments]


def test_a_folder_is_one_scene_and_all_segments_hold_the_rows_of_the_base(cli, train, tmp_path, monkeypatch):
    monkeypatch.setattr(segmented, "FITTING", 60)
    folder = tmp_path / "scene"
    made = train(folder, "--overlap", 0.5, "--iterations", 60)  # enough for motion in the whole
    assert made.code == 0, made.err
    assert {"segments": 2, "kept": 0, "trained": 2, "finished": True}.items() <= made.json.items()
    assert "2 segments from 0 to 4 s, with 11, 9 training views of them; 17 for the model of all times" in made.err
    base, segments = parts(folder)
    own, whole = decode(base), (folder / "whole.pd4").read_bytes()
    assert own.layers == (0,) and len(own.anchor_q) and hashes(base) == hashes(whole, 0)
    assert decode(whole).rows[0] == decode(whole).rows[-1]  # of the anchors of all levels
    for data in segments:
        scene, n = decode(data, base=base), len(own.anchor_q)
        for name in ("anchor_q", *ATTRIBUTES):
            assert np.array_equal(getattr(scene, name)[:n], getattr(own, name))
        assert np.array_equal(scene.mask[0][:n], own.mask[0])
        assert scene.networks["color"][0][0].tobytes() == own.networks["color"][0][0].tobytes()
        assert scene.layers == (0, 1) and scene.deformation(1) is not None  # one layer of motion
        assert refdec.hashes(data, base=base) == hashes(data, base=base)
    assert (segments[0] != segments[1]) and sum(map(len, segments)) == made.json["bytes"] - made.json["base_bytes"]
    assert [s.time_range for s in read_index(folder)[1].segments] == [(0, 2.5), (2, 4)]

    found = cli("info", folder, "--check", "--json").json
    assert found["checked"] and len(found["segments"]) == 2
    assert len(cli("eval", folder, SOURCE, "--json").json["levels"]) == 2
    assert cli("render", folder, "-o", tmp_path / "a.png", "--time", 0.6, "--json").json["width"] == 32
    assert cli("package", folder, "-o", tmp_path / "page").code == 0
    assert (tmp_path / "page" / INDEX).exists()
    if NODE:
        for path in (folder / "00000.pd4", folder / "00001.pd4"):
            said = subprocess.run(
                [NODE, PLAYER, "hashes", path, folder / "base-0000.pd4"], capture_output=True, check=True, timeout=60
            )
            assert json.loads(said.stdout) == hashes(path.read_bytes(), base=base)


def test_an_interrupted_training_goes_on_bit_for_bit(train, tmp_path, monkeypatch):
    train(tmp_path / "whole")
    step, count, at = Learner.step, [0], [5, STEPS + 1, STEPS + EACH + 1]  # in the whole and in both segments

    def counted(self):
        count[0] += 1
        if count[0] in at:
            os.kill(os.getpid(), signal.SIGTERM)
        return step(self)

    monkeypatch.setattr(Learner, "step", counted)
    folder = tmp_path / "scene"
    for i, steps in enumerate(at):
        made = train(folder)
        assert made.json["interrupted"] and not made.json["finished"] and count[0] == steps
        assert made.json["kept"] == 0 and made.json["trained"] == max(i - 1, 0)
        assert not (folder / f"0000{i - 1}.pd4").exists()
    again = train(folder, "--resume", folder)
    assert again.json["finished"] and again.json["kept"] == again.json["trained"] == 1 and count[0] == STEPS + 2 * EACH
    assert parts(folder) == parts(tmp_path / "whole")
    assert train(folder).json["kept"] == 2 and count[0] == STEPS + 2 * EACH


def test_another_training_is_not_continued_and_parts_are_trained_alone(cli, train, tmp_path):
    folder = tmp_path / "scene"
    assert train(folder).code == 0
    other = train(folder, "--seed", 3)
    assert other.code == 1 and "holds another training" in other.err
    before = parts(folder)
    alone = tmp_path / "alone"
    alone.mkdir()
    assert train(alone / "whole.pd4", "--part", "whole").json["finished"]
    assert train(alone / "00001.pd4", "--part", 1, "--whole", alone / "whole.pd4").json["finished"]
    (alone / "00001.pt").unlink()  # the file of a segment is enough
    assert train(alone).json["kept"] == 1
    assert parts(alone) == before
    (alone / "00001.pd4").write_bytes(parts(alone)[1][0])  # not taken for one that was trained, nor replaced
    assert "00001.pd4: is of another base or other times" in train(alone).err
    assert (alone / "00001.pd4").exists()
    steps = [json.loads(checkpoint.load(alone / name)[1]["config"])["iterations"] for name in ("whole.pt", "00000.pt")]
    assert steps == [STEPS, EACH]
    assert train(alone, "--seed", 3, "--overwrite").json["kept"] == 0
    assert parts(alone) != before


def test_a_manifest_trains_the_whole_first(cli, train, tmp_path):
    lines = tmp_path / "parts.jsonl"
    assert train(tmp_path / "x", "--manifest", lines).json["lines"] == 3
    out = tmp_path / "out"
    text = lines.read_text().splitlines()
    lines.write_text("\n".join([*text[1:], text[0]]))  # in any order
    done = cli("batch", lines, "--op", "train", "-o", out, "--workers", 0, "-j", 1, "--json")
    assert done.code == 0 and done.json["done"] == 3, done.err
    joined = train(out)
    assert joined.json["kept"] == 2 and joined.json["trained"] == 0
    assert cli("info", out, "--check").code == 0
    assert cli("batch", lines, "--op", "train", "-o", out, "--workers", 0, "--json").json["already"] == 3
    wrong = json.loads(text[1]) | {"needs": {"data": "whole.pd4"}}
    lines.write_text(json.dumps(wrong))
    assert "found needs" in cli("batch", lines, "--op", "train", "-o", out, "--workers", 0).err


@pytest.mark.parametrize(
    "more, message",
    [
        (("--overlap", 2.5), "an overlap of 2.5 s, expected less than the 2 s of a segment"),
        (("--part", 1), "expected --part N and --whole FILE.pd4 together"),
        (("--log", "a.jsonl"), "--log has no effect with --segments"),
        (("--resume", "elsewhere"), "expected the folder of -o"),
        (("--part", 7, "--whole", "b.pd4"), "found segment 7, expected 0 to 1"),
    ],
)
def test_faults_are_named_in_one_line(train, tmp_path, more, message):
    found = train(tmp_path / "scene", *more)
    assert found.code and message in found.err and len(found.error_lines) == 1


def test_a_segment_without_views_is_named(train, tmp_path):
    found = train(tmp_path / "scene", source=SOURCE.replace("frames=17", "frames=5"), segments=0.5)
    assert found.code == 1 and "has training views of" in found.err and "longer --segments" in found.err


def test_several_segments_train_at_a_time(train, tmp_path):
    """In processes of their own, which have the real preset: few steps."""
    found = train(tmp_path / "scene", "--iterations", 1, "-j", 2)
    assert found.code == 0 and found.json["trained"] == 2, found.err
    assert decode(tmp_path / "scene" / "00001.pd4", base=tmp_path / "scene" / "base-0000.pd4").rows
