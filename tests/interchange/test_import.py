"""Models of other programs straight into a file."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_splats import gsplat_state, make_splats

from pd4dgs_codec import decode
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.format.info import metadata_of
from pd4dgs_codec.interchange import imported
from pd4dgs_codec.interchange.direct import FITTED, Packer, Seen
from pd4dgs_codec.interchange.pack import CLOSE
from pd4dgs_codec.interchange.sampled import sampled
from pd4dgs_codec.interchange.splats import ply_bytes
from pd4dgs_codec.interchange.teacher import Teacher, read_model
from pd4dgs_codec.kinds.splats import Splats, visible

pytestmark = pytest.mark.usefixtures("small_views")


@pytest.fixture
def small_views(monkeypatch):
    monkeypatch.setattr(imported, "CAMERAS", 18)
    monkeypatch.setattr(imported, "SIZE", 64)


def body(count: int = 300, degree: int = 0) -> Splats:
    """Gaussians of which 40 % move with `moved`."""
    return replace(make_splats(count, degree), opacities=np.full(count, 0.9, np.float32))


def moved(splats: Splats, t: float) -> Splats:
    """Some turn and fade, each in its own measure; the others stay."""
    means, opacities, n = splats.means.copy(), splats.opacities.copy(), int(0.4 * len(splats.means))
    angle = np.float32(2 * t)
    x, y, z = splats.means[:n].T
    means[:n] = np.stack([x * np.cos(angle) - y * np.sin(angle), x * np.sin(angle) + y * np.cos(angle), z + t], axis=1)
    opacities[: n // 2] *= np.float32(1 - 0.5 * t)
    return replace(splats, means=means, opacities=opacities)


def sequence(folder: Path, frames: int = 9, shuffled: bool = False) -> Path:
    """Frames as PLY files, in a random order and with some rows lost if shuffled."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(frames):
        splats = moved(body(), i / (frames - 1) / (4 if shuffled else 1))
        rows = rng.permutation(300)[:290] if shuffled else np.arange(300)
        (folder / f"{i:04d}.ply").write_bytes(ply_bytes(splats.taken(rows)))
    return folder


def test_still_files(tmp_path, cli):
    splats = body(degree=2)
    (tmp_path / "a.ply").write_bytes(ply_bytes(splats))
    torch.save({"splats": gsplat_state(splats)}, tmp_path / "b.pt")
    for name in ("a.ply", "b.pt"):
        out = tmp_path / "scene.pd4"
        result = cli("import_model", tmp_path / name, "-o", out, "-f", "--psnr", 45, "--json", "--title", "A")
        assert result.code == 0, result.err
        found = result.json
        assert found["psnr"]["0"] > 43 and found["bytes"] == out.stat().st_size
        about = metadata_of(out.read_bytes())
        assert about.title == "A" and about.quality[0] == pytest.approx(found["psnr"]["0"])
        assert found["gaussians"] + found["gaussians_left_out"] == 300
        scene = decode(out.read_bytes())
        assert scene.layers == (0,) and scene.splats(0.0)[0].degree == 2
    quiet = cli("import_model", tmp_path / "a.ply", "-o", tmp_path / "c.pd4")
    assert quiet.code == 0 and "300 Gaussians, harmonics of degree 2, static" in quiet.err


def test_gaussians_that_are_not_worth_their_bits_are_left_out(tmp_path, monkeypatch, cli):
    monkeypatch.setattr(imported, "CAMERAS", 40)  # enough to tell what other views would miss
    splats, dust = body(), body()
    dust = replace(dust, scales=dust.scales * 0.05, opacities=np.full(300, 0.02, np.float32))
    both = {name: np.concatenate([getattr(splats, name), getattr(dust, name)]) for name in vars(splats)}
    (tmp_path / "a.ply").write_bytes(ply_bytes(replace(splats, **both)))
    found = cli("import_model", tmp_path / "a.ply", "-o", tmp_path / "a.pd4", "--psnr", 40, "--json").json
    assert found["psnr"]["0"] > 38.5 and 200 < found["gaussians"] < 330


def test_frames_in_order_become_tracks(tmp_path, cli):
    out = tmp_path / "scene.pd4"
    result = cli("import_model", sequence(tmp_path / "set"), "-o", out, "--psnr", 40, "--fps", 4, "--json")
    assert result.code == 0, result.err
    assert result.json["order"] == "rows in a stable order" and result.json["static"] == pytest.approx(0.6, abs=0.01)
    assert result.json["psnr"]["1"] > 37 and result.json["psnr"]["0"] < result.json["psnr"]["1"] - 3
    scene = decode(out.read_bytes())
    heads = {name for tracks in scene.tracks.values() for name in tracks.heads}
    assert scene.info.time_range == (0.0, 2.0) and {"position", "opacity"} <= heads


def test_frames_without_an_order_are_matched(tmp_path, cli):
    out = tmp_path / "scene.pd4"
    result = cli("import_model", sequence(tmp_path / "set", shuffled=True), "-o", out, "--psnr", 36, "--json")
    assert result.code == 0, result.err
    assert "no stable order" in result.json["order"] and 0.7 < result.json["matched"] < 1
    assert max(result.json["psnr"].values()) > 32
    assert "window" in decode(out.read_bytes()).tensors


def test_random_frames_have_no_order():
    frames = [make_splats(200, 0, seed) for seed in range(4)]
    model = Teacher(lambda t: frames[round(3 * t)], tuple(np.linspace(0, 1, 4)), 1.0)
    found = sampled(model, "frames")
    assert found.matched < 0.5 and found.windows is not None
    for i, frame in enumerate(frames):  # each frame shows its own Gaussians
        shown = found.frame(i, bare=False)
        seen = shown.opacities > 1e-3
        assert np.count_nonzero(seen) == 200
        np.testing.assert_array_equal(np.sort(shown.means[seen], axis=0), np.sort(frame.means, axis=0))


def test_harmonics_are_means_over_frames_of_the_least_degree():
    frames = [replace(body(degree=d), sh=make_splats(300, d, seed).sh) for seed, d in enumerate((2, 1, 2))]
    frames = [replace(frame, sh=np.concatenate([frames[0].sh[:, :1], frame.sh[:, 1:]], axis=1)) for frame in frames]
    model = Teacher(lambda t: frames[round(2 * t)], (0.0, 0.5, 1.0), 1.0)
    found = sampled(model, "frames")
    assert found.order == "rows in a stable order" and found.frame(1).degree == 1
    np.testing.assert_allclose(found.rest, np.mean([frame.sh[:, 1:4] for frame in frames], axis=0), atol=1e-6)


def test_a_function_is_sampled_where_it_bends(tmp_path, monkeypatch, cli):
    (tmp_path / "late.py").write_text(
        "from test_import import body, moved\ndef model(t):\n    return vars(moved(body(), 4 * max(t - 0.75, 0)))\n"
    )
    monkeypatch.chdir(tmp_path)
    found = sampled(read_model("late:model", 30), "late:model")
    gaps = np.diff(found.times)
    assert gaps[-1] <= gaps[0] / 4
    result = cli("import_model", "late:model", "-o", "late.pd4", "--target-size", "4k", "--json")
    assert result.code == 0, result.err
    assert 0.85 * 4000 < Path("late.pd4").stat().st_size <= 4000 and max(result.json["psnr"].values()) > 30


def test_a_motion_that_repeats_with_the_samples_is_not_still():
    """It is at the same place at all of the first samples, and half way between them."""
    still = body()

    def at(t: float) -> Splats:
        return replace(still, means=still.means + np.float32([np.sin(2 * np.pi * 16 * t), 0, 0]))

    found = sampled(Teacher(at, None, 1.0), "waves")
    assert not found.static.any() and np.ptp(found.means, axis=0)[:, 0].min() > 1.9


def brief(folder: Path, way: str) -> Path:
    """25 frames of a body, and 60 Gaussians above it in frame 17 only: as further rows, or as rows that fade in."""
    folder.mkdir()
    splats, more = body(), body(60)
    more = replace(more, means=more.means / 4 + np.float32([0, 0, 2]))
    both = Splats(**{name: np.concatenate([part, getattr(more, name)]) for name, part in vars(splats).items()})
    for i in range(25):
        faded = replace(both, opacities=both.opacities * (np.arange(360) < 300))
        frame = both if i == 17 else splats if way == "rows" else faded
        (folder / f"{i:02d}.ply").write_bytes(ply_bytes(frame))
    return folder


@pytest.mark.parametrize("way", ["rows", "fade"])
def test_gaussians_that_no_usual_picture_shows_are_kept(tmp_path, cli, way):
    out = tmp_path / "a.pd4"
    result = cli("import_model", brief(tmp_path / "set", way), "-o", out, "--psnr", 36, "--json")
    assert result.code == 0 and result.json["gaussians_left_out"] < 20, result.err
    scene = decode(out.read_bytes())
    shown = {i: np.count_nonzero(scene.splats(i / 24)[0].opacities > 0.4) for i in (15, 17)}
    assert shown[17] - shown[15] > 50 or way == "fade"  # whose motion may cost more bits than it is worth


def test_level_0_has_what_its_instant_shows_and_all_views_have_the_psnr_asked_for(monkeypatch):
    monkeypatch.setattr(imported, "CAMERAS", 48)
    splats, hidden = body(), np.arange(300) % 2 == 1

    def at(t: float) -> Splats:  # every second one is hidden in the middle
        return replace(splats, opacities=np.where(hidden, splats.opacities * abs(2 * t - 1), splats.opacities))

    model = Teacher(at, tuple(np.linspace(0, 1, 9)), 1.0)
    source = sampled(model, "hidden")
    some = [source.frame(i) for i in range(9)]
    info, cameras, _ = imported.scene_info("hidden", model, some, 1.0, None, None)
    packer = Packer(model, source, cameras, info, lambda: None)
    scene = packer.matched(38.0)
    early, dark = scene.mask[0] > 0, scene.tensors["opacity"][:, 0] < 0
    assert np.count_nonzero(early) > 80 < np.count_nonzero(dark) and np.count_nonzero(early & dark) < 5
    guess = packer.guess(38.0)
    coarse, fresh = (Packer(model, source, cameras, info, lambda: None) for _ in range(2))
    coarse.scene(300 * guess)  # whose rounds decide nothing at thetas far below
    for name, values in fresh.scene(10 * guess).tensors.items():
        np.testing.assert_array_equal(coarse.scene(10 * guess).tensors[name], values)

    def psnr(theta: float, *seen: Seen) -> float:
        return 40 - 10 * np.log10(theta / guess) + (2 if seen == (packer.checked,) else 0)

    monkeypatch.setattr(packer, "scene", lambda theta: theta)
    monkeypatch.setattr(packer, "_psnr", psnr)
    found = packer.matched(38.0)  # of all views, and not of the few that are drawn in each round
    assert packer._psnr(found, packer.checked, *packer.deciding) == pytest.approx(38 + FITTED, abs=CLOSE)


def test_every_window_is_looked_at():
    """At a time between the samples if it is so short; those that are never open need no picture."""
    still = body()
    centers = np.linspace(-0.4, 1.4, 300)
    windows = np.stack([centers, np.zeros(300), np.full(300, 0.003)], axis=1).astype(np.float32)
    moving = Teacher(lambda t: still, None, 1.0, windows=windows, bare=lambda t: still)
    found = sampled(moving, "windows")
    times, often = found.looks(20)
    seen = np.sum([visible(windows, t) > 0.5 for t in times], axis=0)
    assert len(times) < 800 and seen[(centers > 0) & (centers < 1)].min() >= 4 and not often.all()


def test_files_and_harmonics_that_are_left_out_are_named(tmp_path, cli):
    source = sequence(tmp_path / "set")
    (source / "0009.splat").write_bytes(bytes(32))
    (source / "0003.ply").write_bytes(ply_bytes(body(degree=1)))
    result = cli("import_model", source, "-o", tmp_path / "a.pd4", "--psnr", 30)
    assert "1 of 10 files are left out, expected all to end in .ply" in result.err
    assert "harmonics above degree 0 are left out, expected degree 1 at all instants" in result.err
    (source / "mean.ply").write_bytes(ply_bytes(body()))
    _refused(cli, source, "mean.ply: has no number")


SPINS = """
import numpy as np
from test_import import body
rng = np.random.default_rng(1)
axes, speeds, phases = (rng.normal(size=(200, k)) for k in (3, 1, 1))
axes /= np.linalg.norm(axes, axis=1, keepdims=True)
def model(t):
    half = np.sin(120 * speeds * t + phases)
    return vars(body(200)) | {"quats": np.concatenate([np.cos(half), axes * np.sin(half)], axis=1)}
"""


def test_no_head_has_more_bases_than_a_file_can_hold(tmp_path, monkeypatch, cli):
    """Each Gaussian turns in its own way: no few bases do."""
    (tmp_path / "spins.py").write_text(SPINS)
    monkeypatch.chdir(tmp_path)
    result = cli("import_model", "spins:model", "-o", "spins.pd4", "--psnr", 50, "--json")
    assert result.code == 0, result.err
    heads = [tracks.heads for tracks in decode(Path("spins.pd4").read_bytes()).tracks.values()]
    assert sum(len(own["rotation"].bases) for own in heads if "rotation" in own) == 64


def test_spacetime_gaussians(tmp_path, cli):
    """Against their formulas, written out here."""
    rng, n = np.random.default_rng(0), 50
    values = {name: rng.normal(0, 0.3, n) for name in ("x", "y", "z", "opacity", *(f"f_dc_{i}" for i in range(3)))}
    values |= {f"motion_{i}": rng.normal(0, 0.5, n) for i in range(9)}
    values |= {f"rot_{i}": rng.normal(size=n) for i in range(4)} | {f"omega_{i}": rng.normal(size=n) for i in range(4)}
    values |= {f"scale_{i}": rng.normal(-2, 0.2, n) for i in range(3)}
    values |= {"trbf_center": rng.uniform(0, 1, n), "trbf_scale": rng.normal(-1, 0.3, n)}
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 50\n"
    head += "".join(f"property float {name}\n" for name in values) + "end_header\n"
    path = tmp_path / "point_cloud.ply"
    path.write_bytes(head.encode() + np.stack([*values.values()], axis=1).astype("<f4").tobytes())
    model = read_model(str(path), 30)
    for t in (0.0, 0.4, 1.0):
        d = t - values["trbf_center"]
        near = np.abs(d) < 2 * np.exp(values["trbf_scale"])
        x = values["x"] + values["motion_0"] * d + values["motion_3"] * d**2 + values["motion_6"] * d**3
        opacity = np.exp(-np.square(d / np.exp(values["trbf_scale"]))) / (1 + np.exp(-values["opacity"]))
        found = model.splats(t)
        np.testing.assert_allclose(found.means[near, 0], x[near], atol=1e-5)
        np.testing.assert_allclose(found.opacities, opacity, atol=1e-5)
        np.testing.assert_allclose(found.base_colors[:, 0], np.clip(values["f_dc_0"], 0, 1), atol=1e-5)
    result = cli("import_model", path, "-o", tmp_path / "a.pd4", "--psnr", 38, "--json")
    assert result.code == 0, result.err
    assert max(result.json["psnr"].values()) > 34
    path.write_bytes(path.read_bytes().replace(b"float omega_3", b"float f_t_0xx"[:13]))
    with pytest.raises(DataError, match="omega_3"):
        read_model(str(path), 30)
    path.write_bytes(path.read_bytes().replace(b"float f_t_0xx", b"float f_t_0\n"))
    with pytest.raises(DataError, match="full model"):
        read_model(str(path), 30)


# -- bad input ---------------------------------------------------------------------------------------------------------

EXPLODES = """
import numpy as np
def at_once(t):
    far = np.float32(np.inf if t == 1 else t)
    return dict(means=np.zeros((9, 3)) + far, quats=np.ones((9, 4)), scales=np.ones((9, 3)), opacities=np.ones(9),
                colors=np.ones((9, 3)))
def in_part(t):
    found = at_once(0)
    found["means"][4] = np.nan if t == 1 else t
    return found
"""


def _refused(cli, source, message, *options):
    out = Path("scene.pd4")
    before = sorted(Path().rglob("*"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        result = cli("import_model", source, "-o", out, *options)
    told = [line for line in result.error_lines if "error:" in line]
    assert result.code == 1 and len(told) == 1 and message in told[0], result.err
    assert sorted(Path().rglob("*")) == before, "something was written"


def test_bad_input_is_refused_in_one_line(tmp_path, monkeypatch, cli):
    monkeypatch.chdir(tmp_path)
    Path("bad.py").write_text(EXPLODES)
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    _refused(cli, "bad:at_once", "at 1: none of 9 Gaussians is finite")
    _refused(cli, "bad:in_part", "8 usable Gaussians at 1 and 9 at 0")
    folder = sequence(tmp_path / "set")
    (folder / "0004.ply").rename(tmp_path / "kept")
    _refused(cli, folder, "has no frame 4, expected one for each number from 0 to 8")
    data = (tmp_path / "kept").read_bytes()
    (folder / "0004.ply").write_bytes(data[: len(data) // 2])
    _refused(cli, folder, "0004.ply")
    (folder / "0004.ply").write_bytes(data.replace(b"vertex 300", b"vertex 999999999"))
    _refused(cli, folder, "0004.ply")
    Path("nan.ply").write_bytes(ply_bytes(replace(body(), means=np.full((300, 3), np.nan, np.float32))))
    _refused(cli, "nan.ply", "none of 300 Gaussians is finite")
    Path("unseen.ply").write_bytes(ply_bytes(replace(body(), opacities=np.zeros(300, np.float32))))
    _refused(cli, "unseen.ply", "found none of 300 Gaussians in any picture")
    Path("one.ply").write_bytes(ply_bytes(body()))
    _refused(cli, "one.ply", "found --fps for a source without frames", "--fps", "25")
    _refused(cli, "one.ply", "target size: the smallest file tried takes", "--target-size", "500")
    _refused(cli, "none.ply", "found nothing")


def test_too_many_frames_and_gaussians_are_refused():
    still = make_splats(200, 0)
    many = Teacher(lambda t: still, tuple(np.linspace(0, 1, 1_000_000)), 1.0)
    with pytest.raises(DataError, match="holds 1,000,000 frames, expected at most 4,096"):
        sampled(many, "many")
    wide = Splats(*(np.broadcast_to(part[:1], (20_000_000, *part.shape[1:])) for part in vars(still).values()))
    large = Teacher(lambda t: wide, tuple(np.linspace(0, 1, 100)), 1.0)
    with pytest.raises(DataError, match="20,000,000 Gaussians at 100 instants"):
        sampled(large, "large")


def test_a_run_whose_tensors_disagree(tmp_path, monkeypatch, cli):
    from teachers import FourD

    monkeypatch.chdir(tmp_path)
    run = FourD(make_splats()).save(tmp_path / "run", make_splats())
    path = run / "point_cloud/iteration_7/deformation.pth"
    state = torch.load(path)
    state["deformation_net.pos_deform.1.weight"] = state["deformation_net.pos_deform.1.weight"][:, :5]
    torch.save(state, path)
    _refused(cli, run, "pos_deform.1.weight has shape")


def test_options_that_do_not_fit(tmp_path, cli):
    for out, option, message in (
        ("a.pt", ("--psnr", 40), "--psnr needs a .pd4 file"),
        ("a.pd4", ("--appearance", 1), "--appearance needs -o model.pt"),
        ("a.pd4", ("--psnr", 40, "--quality", 3), "not allowed with"),
        ("a.pd4", ("--up", "0,0,0"), "expected X,Y,Z"),
    ):
        result = cli("import_model", tmp_path / "x.ply", "-o", tmp_path / out, *option)
        assert result.code == 2 and message in result.err


def test_many_gaussians_at_one_place(tmp_path, cli):
    """They get voxels of their own, in a time that does not grow with the square of their number."""
    splats = make_splats(5000, 0)
    splats.means[:] = [1, 2, 3]
    (tmp_path / "a.ply").write_bytes(ply_bytes(splats))
    result = cli("import_model", tmp_path / "a.ply", "-o", tmp_path / "a.pd4", "--psnr", 30, "--json")
    assert result.code == 0, result.err
    assert result.json["psnr"]["0"] > 25
    np.testing.assert_allclose(
        decode((tmp_path / "a.pd4").read_bytes()).anchor, [[1, 2, 3]] * result.json["gaussians"], atol=0.5
    )
