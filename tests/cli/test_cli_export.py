"""`pd4dgs-export`: what it writes, and one line for what it cannot."""

from dataclasses import replace

import pytest
from tiny import sighted

from pd4dgs_codec.cli.export import frame_times
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.interchange.splats import properties


def _count(path) -> int:
    head = path.read_bytes().split(b"end_header\n")[0].decode().splitlines()
    assert [line.split()[2] for line in head if line.startswith("property")] == properties(1)
    return int(head[2].split()[2])


def test_one_instant_as_ply(cli, scene_pd4, tmp_path):
    out = tmp_path / "scene.ply"
    command = ("export", scene_pd4, "-o", out, "--sh", 1, "--json")
    result = cli(*command, "--time", 0.5)
    assert result.code == 0, result.err
    assert result.json["gaussians"] == _count(out) > 20 and result.json["bytes"] == out.stat().st_size
    assert result.json["level"] == 2 and result.json["frames"] == 1
    middle = out.read_bytes()
    again = cli(*command, "--time", 0.5)
    assert again.code == 1 and "exists already; --overwrite replaces it" in again.err and out.read_bytes() == middle
    assert cli(*command, "--time", 0, "-f").code == 0 and out.read_bytes() != middle
    assert cli(*command, "--time", 0, "-f", "--level", 0, "-v").json["level"] == 0


def test_a_level_that_the_file_lacks_is_told(cli, scene, tmp_path):
    file = tmp_path / "still.pd4"
    file.write_bytes(encode(scene.prefix(0), effort=1))
    done = cli("export", file, "-o", tmp_path / "a.ply", "--to", "ply", "--sh", 0, "--level", 2)
    assert done.code == 0 and "a.ply: level 0, " in done.err


def test_the_whole_time_as_a_folder_of_plys(cli, scene_pd4, tmp_path):
    out = tmp_path / "frames"
    command = ("export", scene_pd4, "-o", out, "--to", "ply-seq", "--sh", 1, "--json")
    result = cli(*command, "--fps", 2)  # the scene takes two seconds
    assert result.code == 0, result.err
    frames = sorted(out.iterdir())
    assert [path.name for path in frames] == [f"{i:05d}.ply" for i in range(5)] and result.json["frames"] == 5
    assert all(_count(path) > 20 for path in frames) and len({path.read_bytes() for path in frames}) == 5
    again = cli(*command, "--fps", 1)
    assert again.code == 1 and "contains PLY files already" in again.err
    assert cli(*command, "--fps", 1, "-f").code == 0
    assert sorted(path.name for path in out.iterdir()) == ["00000.ply", "00001.ply", "00002.ply"]


def faint(scene, bias: float):
    """The scene with lower opacities."""
    *rest, (weight, offset) = scene.networks["opacity"]
    return sighted(replace(scene, networks=scene.networks | {"opacity": (*rest, (weight, offset - bias))}))


def test_a_frame_may_be_empty_but_not_all(cli, scene, tmp_path):
    fourdgs = pytest.importorskip("fourdgs")
    file, frames, moving = tmp_path / "scene.pd4", tmp_path / "frames", tmp_path / "scene.4dgs"
    file.write_bytes(encode(faint(scene, 2.8), effort=1))
    seen = [1, 0, 1, 1, 1]
    for out, kind in ((frames, "ply-seq"), (moving, "4dgs")):
        result = cli("export", file, "-o", out, "--to", kind, "--fps", 2, "--sh", 1, "--json")
        assert result.code == 0 and result.json["frames"] == 5 and result.json["gaussians"] == 1, result.err
    assert [_count(path) for path in sorted(frames.iterdir())] == seen
    state_at = fourdgs.read(moving.read_bytes()).state_at
    assert [len(state_at(i / 2)["indices"]) for i in range(5)] == seen

    result = cli("export", file, "-o", tmp_path / "a.ply", "--time", 0.25)
    assert result.code == 1 and "has no visible Gaussians at this level and this time, expected some" in result.err
    file.write_bytes(encode(faint(scene, 9), effort=1))
    for kind in ("ply-seq", "4dgs"):
        result = cli("export", file, "-o", tmp_path / "none", "--to", kind, "--fps", 2)
        assert result.code == 1 and "at this level and any time" in result.err and not (tmp_path / "none").exists()


def test_the_number_of_frames_is_limited(scene):
    with pytest.raises(DataError, match="10000 seconds at 30 frames per second are 300001 frames, expected at most"):
        frame_times(replace(scene.info, time_range=(0.0, 1e4)), 30.0)


def test_the_cost_is_printed(cli, scene_pd4, shared_dataset, tmp_path):
    command = ("export", scene_pd4, "--to", "ply", "--sh", 0)
    result = cli(*command, "-o", tmp_path / "a.ply", "--data", shared_dataset, "--compare", shared_dataset, "--json")
    assert result.code == 0, result.err
    cost = result.json["cost"]
    assert cost["views"] == 1 and all(0 < cost[key] < 100 for key in cost)
    told = cli(*command, "-o", tmp_path / "b.ply", "--compare", shared_dataset)
    assert "1 held-out views" in told.err and "dB rendered directly" in told.err


@pytest.mark.parametrize("kind", ["glb", "spz", "4dgs"])
def test_other_kinds(cli, scene_pd4, tmp_path, kind):
    if kind in ("spz", "4dgs"):
        pytest.importorskip({"spz": "gaussforge", "4dgs": "fourdgs"}[kind])
    out = tmp_path / f"scene.{kind}"
    options = ("--fps", 2) if kind == "4dgs" else ("--time", 1)
    result = cli("export", scene_pd4, "-o", out, "--json", *options)
    assert result.code == 0, result.err
    assert result.json["bytes"] == out.stat().st_size > 100
