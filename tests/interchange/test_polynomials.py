"""Gaussians on polynomials of time, under windows, against the published formulas written out here."""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from test_import import _refused, small_views  # noqa: F401 (a fixture)

from pd4dgs_codec import decode
from pd4dgs_codec.errors import DamageWarning, DataError
from pd4dgs_codec.interchange.sampled import sampled
from pd4dgs_codec.interchange.teacher import Teacher, read_model
from pd4dgs_codec.kinds.splats import Splats, visible

TIMES = (0.0, 0.3, 0.5, 1.0)


def splatv(count: int = 60, seed: int = 0, **changed: np.ndarray) -> tuple[bytes, dict[str, np.ndarray]]:
    """A .splatv file with an empty row after the Gaussians, as textures have them, and its numbers."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count + 1, [
        ("xyz", "<f4", 3), ("rot01", "<f2", 2), ("rot23", "<f2", 2), ("scale", "<f2", 4), ("rgba", "u1", 4),
        ("motion", "<f2", 10), ("omega", "<f2", 4), ("trbf", "<f2", 2),
    ])  # fmt: skip
    used = rows[:count]
    used["xyz"], used["motion"][:, :9] = rng.normal(0, 0.5, (count, 3)), rng.normal(0, 0.3, (count, 9))
    used["rot01"], used["rot23"] = rng.normal(size=(2, count, 2))
    used["scale"][:, :3], used["omega"] = np.exp(rng.normal(-2, 0.2, (count, 3))), rng.normal(size=(count, 4))
    used["rgba"] = rng.integers(40, 256, (count, 4))
    used["trbf"] = np.stack([rng.uniform(0, 1, count), rng.uniform(0.1, 0.5, count)], axis=1)
    for name, values in changed.items():
        used[name][: len(values)] = values
    camera = {"position": [0, 0, -4], "rotation": np.eye(3).tolist(), "fx": 60, "fy": 60, "width": 64, "height": 64}
    part = {"type": "splat", "size": rows.nbytes, "texwidth": 4096, "texheight": 1, "cameras": [camera]}
    text = json.dumps([part]).encode()
    head = np.array([0x674B, len(text)], "<u4").tobytes()
    return head + text + rows.tobytes(), {name: used[name].astype(np.float64) for name in rows.dtype.names or ()}


def turned(quats: np.ndarray) -> np.ndarray:
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def test_splatv(tmp_path, cli):
    data, rows = splatv()
    path = tmp_path / "a"
    path.write_bytes(data)
    model = read_model(str(path), 30)
    for t in TIMES:
        d = t - rows["trbf"][:, :1]
        factor = np.exp(-np.square(d[:, 0] / rows["trbf"][:, 1]))
        near = factor >= 0.02
        m = rows["motion"]
        means = rows["xyz"] + m[:, :3] * d + m[:, 3:6] * d**2 + m[:, 6:9] * d**3
        quats = turned(np.concatenate([rows["rot01"], rows["rot23"]], axis=1) + rows["omega"] * d)
        found = model.splats(t)
        np.testing.assert_allclose(found.means[near], means[near], atol=1e-5)
        np.testing.assert_allclose(np.abs((found.quats * quats).sum(axis=1))[near], 1, atol=1e-5)
        np.testing.assert_allclose(found.scales, rows["scale"][:, :3], atol=1e-6)
        np.testing.assert_allclose(found.opacities, rows["rgba"][:, 3] / 255 * factor * near, atol=1e-6)
        np.testing.assert_allclose(found.base_colors, rows["rgba"][:, :3] / 255, atol=1e-6)
    packed(model, path, tmp_path / "a.pd4", cli)


def packed(model: Teacher, source: Path, out: Path, cli) -> None:
    """Imports the source: windows as they are, and what stays still costs no tracks."""
    result = cli("import_model", source, "-o", out, "--psnr", 38, "--json")
    assert result.code == 0, result.err
    assert max(result.json["psnr"].values()) > 34
    scene = decode(out.read_bytes())
    assert "window" in scene.tensors and scene.tracks and model.windows is not None
    assert all(set(tracks.heads) <= {"position", "rotation", "color"} for tracks in scene.tracks.values())


def checkpoint(
    path: Path, count: int = 60, *, span: tuple[float, float] = (0, 1), turns: bool = True, cosines: int = 2, sky=None,
    **changed,
) -> dict[str, torch.Tensor]:  # fmt: skip
    """Writes a checkpoint of 4DGS, with its optimiser and with numbers of numpy as its trainer leaves them. span: first
    and last instant. changed: the first rows of tensors."""
    torch.manual_seed(0)
    length, coefficients = span[1] - span[0], 48 if cosines else 16
    tensors = {
        "xyz": torch.randn(count, 3) * 0.5, "f_dc": torch.randn(count, 1, 3),
        "f_rest": torch.randn(count, coefficients - 1, 3) * 0.1, "scaling": torch.randn(count, 3) * 0.2 - 2,
        "rotation": torch.randn(count, 4), "opacity": torch.randn(count, 1),
        "t": span[0] + (torch.rand(count, 1) * 1.2 - 0.1) * length,
        "scaling_t": torch.log(torch.rand(count, 1) * 0.3 + 0.1) + np.log(length),
        "rotation_r": torch.randn(count, 4) if turns else torch.empty(0),
    }  # fmt: skip
    for name, rows in changed.items():
        tensors[name] = torch.cat([torch.as_tensor(rows), tensors[name][len(rows) :]])
    kept = {name: torch.nn.Parameter(values) for name, values in tensors.items()}
    radius = np.float32(5.5)  # of a camera rig, by numpy
    groups = [{"params": [values], "lr": np.float64(0.00016) * radius, "name": name} for name, values in kept.items()]
    optimiser = torch.optim.Adam(groups, lr=0.0, eps=1e-15)
    sum((0 * values).sum() for values in kept.values()).backward()
    optimiser.step()
    still = [torch.zeros(count), torch.zeros(count, 1), torch.zeros(count, 1), torch.zeros(count, 1)]
    names = ("xyz", "f_dc", "f_rest", "scaling", "rotation", "opacity")
    parts = (3, *(kept[name] for name in names), *still, optimiser.state_dict(), radius * np.float64(1.1),
             kept["t"], kept["scaling_t"], kept["rotation_r"], turns, sky, cosines)  # fmt: skip
    torch.save((parts, 30_000), path)
    return {name: values.detach().double() for name, values in kept.items()}


def plain_4d(
    rows: dict[str, torch.Tensor], t: float, length: float, turns: bool, cosines: int
) -> dict[str, np.ndarray]:
    """The conditional Gaussians at instant t, and their covariances, from the precision matrix in space and time."""
    dt = t - rows["t"][:, 0]
    if turns:
        left, right = (torch.nn.functional.normalize(rows[name]) for name in ("rotation", "rotation_r"))
        (a, b, c, d), (p, q, r, s) = left.unbind(1), right.unbind(1)
        by_left = torch.stack([a, -b, -c, -d, b, a, -d, c, c, d, a, -b, d, -c, b, a], dim=1).reshape(-1, 4, 4)
        by_right = torch.stack([p, q, r, s, -q, p, -s, r, -r, s, p, -q, -s, -r, q, p], dim=1).reshape(-1, 4, 4)
        turn, size = by_left @ by_right, torch.cat([rows["scaling"], rows["scaling_t"]], dim=1).exp()
        precision = turn @ torch.diag_embed(size**-2) @ turn.transpose(1, 2)
        space = torch.linalg.inv(precision[:, :3, :3])  # the covariance at an instant
        means = rows["xyz"] - (space @ precision[:, :3, 3:])[..., 0] * dt[:, None]
        variance = (turn @ torch.diag_embed(size**2) @ turn.transpose(1, 2))[:, 3, 3]
    else:
        w, x, y, z = torch.nn.functional.normalize(rows["rotation"]).unbind(1)
        axes = torch.stack([
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ], dim=1).reshape(-1, 3, 3)  # fmt: skip
        space = axes @ torch.diag_embed((2 * rows["scaling"]).exp()) @ axes.transpose(1, 2)
        means, variance = rows["xyz"], rows["scaling_t"][:, 0].exp()
    marginal = torch.exp(-0.5 * dt**2 / variance)
    sh = torch.cat([rows["f_dc"], rows["f_rest"]], dim=1)
    waves = [torch.cos(2 * torch.pi * k * dt / length)[:, None, None] for k in range(1, cosines + 1)]
    sh = sh[:, :16] + sum(wave * sh[:, 16 * k : 16 * k + 16] for k, wave in enumerate(waves, 1))
    opacities = torch.sigmoid(rows["opacity"][:, 0]) * marginal * (marginal > 0.05)
    parts = {"means": means, "space": space, "opacities": opacities, "sh": sh}
    return {name: values.numpy() for name, values in parts.items()}


def covariances(splats: Splats) -> np.ndarray:
    from pd4dgs_codec.data.view import rotation_matrix

    factor = rotation_matrix(splats.quats.astype(np.float64)) * splats.scales[:, None]
    return np.asarray(factor @ factor.transpose(0, 2, 1))


@pytest.mark.parametrize(
    "span, turns, cosines",
    [((0.0, 1.0), True, 2), ((0.0, 10.0), True, 1), ((-0.5, 0.5), True, 0), ((0.0, 50.0), False, 2)],
)
def test_4dgs_checkpoints(tmp_path, span, turns, cosines, cli):
    path, length = tmp_path / "chkpnt30000.pth", span[1] - span[0]
    rows = checkpoint(path, 400, span=span, turns=turns, cosines=cosines)
    model = read_model(str(tmp_path), 30)
    assert model.seconds == length
    for t in TIMES:
        expected, found = plain_4d(rows, span[0] + t * length, length, turns, cosines), model.splats(t)
        shown = expected["opacities"] > 0
        assert 0 < shown.sum() < 400
        np.testing.assert_allclose(found.opacities, expected["opacities"], atol=1e-5)
        np.testing.assert_allclose(found.means[shown], expected["means"][shown], atol=1e-4)
        np.testing.assert_allclose(found.sh[shown], expected["sh"][shown], atol=1e-4)
        np.testing.assert_allclose(covariances(found)[shown], expected["space"][shown], atol=1e-5)
    if cosines == 0:
        packed(model, path, tmp_path / "a.pd4", cli)


def test_the_duration_of_a_checkpoint_may_be_given(tmp_path):
    rows = checkpoint(path := tmp_path / "chkpnt7.pth", 400, span=(0, 4))
    assert read_model(str(path), 30).seconds == pytest.approx(4, rel=0.1)
    model = read_model(str(path), 30, seconds=4.0)
    assert model.seconds == 4.0
    expected = plain_4d(rows, 2.0, 4.0, True, 2)
    np.testing.assert_allclose(model.splats(0.5).opacities, expected["opacities"], atol=1e-5)


def test_the_last_checkpoint_and_the_options_of_the_run(tmp_path):
    for name in ("chkpnt_best.pth", "chkpnt7000.pth", "chkpnt30000.pth"):
        checkpoint(tmp_path / name, 5 if name == "chkpnt30000.pth" else 6)
    (tmp_path / "input.ply").write_bytes(b"ply\n")
    plain = read_model(str(tmp_path), 30)
    (tmp_path / "cfg_args").write_text("Namespace(white_background=True, prefilter_var=0.04)")
    blurred = read_model(str(tmp_path), 30)
    assert len(plain.splats(0).means) == 5 and plain.background == (0, 0, 0) and blurred.background == (1, 1, 1)
    assert plain.windows is not None and blurred.windows is not None
    np.testing.assert_allclose(blurred.windows[:, 2] ** 2, plain.windows[:, 2] ** 2 + 0.04, rtol=1e-5)


def test_harmonics_over_time_are_means_over_the_bells(tmp_path):
    """But constants, which tracks change. The mean of a cosine under a bell is exp(-(2 pi k s)^2 / 2)."""
    checkpoint(path := tmp_path / "chkpnt7.pth", 30)
    model = read_model(str(path), 30)
    assert model.bare and model.windows is not None
    for i in range(30):
        center, _, softness = model.windows[i]
        times = center + np.linspace(-3, 3, 61) * softness
        bell = np.exp(-0.5 * ((times - center) / softness) ** 2)
        exact = sum(model.splats(t).sh[i] * w for t, w in zip(times, bell, strict=True)) / bell.sum()
        np.testing.assert_allclose(model.bare(0.2).sh[i, 1:], exact[1:], atol=5e-3)
    np.testing.assert_allclose(model.bare(0.2).sh[:, 0], model.splats(0.2).sh[:, 0], atol=1e-6)


def test_lines_and_windows_of_4dgs_files_are_exact(tmp_path, cli):
    fourdgs = pytest.importorskip("fourdgs")
    rng, n = np.random.default_rng(0), 80
    bells, seconds = np.arange(n) % 2 == 0, 2.0
    low = np.where(bells, 0, np.where(np.arange(n) % 3 == 0, 0, 0.6))
    part = dict(
        positions=rng.normal(0, 0.5, (n, 3)), scales=np.exp(rng.normal(-2, 0.2, (n, 3))),
        rotations=turned(rng.normal(size=(n, 4))), colors=rng.uniform(0.3, 1, (n, 4)),
        motions=rng.normal(0, 0.2, (n, 3)), mu_t=rng.uniform(0, seconds, n), sigma_t=np.where(bells, 0.4, np.inf),
    )  # fmt: skip
    part = {name: values.astype(np.float32) for name, values in part.items()}
    part |= {"win_lo": low, "win_hi": np.where(bells | (low == 0), seconds, 1.4)}
    with open(path := tmp_path / "a.4dgs", "wb") as stream:
        fourdgs.write(stream, fourdgs.GaussianSet(**part, sh=None, sh_degree=0), seconds)
    model = read_model(str(path), 30)
    assert model.windows is not None and model.bare and not model.varies
    for t in (0.0, 0.31, 0.5, 0.69):
        bare, shown, exact = model.bare(t), visible(model.windows, t), model.splats(t)
        seen = bare.opacities * shown > 0.05
        here, there = (np.lexsort(np.round(x, 3).T) for x in (bare.means[seen], exact.means[exact.opacities > 0.05]))
        assert len(here) == len(there) > 20
        for name in ("means", "scales", "sh"):
            mine, theirs = getattr(bare, name)[seen][here], getattr(exact, name)[exact.opacities > 0.05][there]
            np.testing.assert_allclose(mine, theirs, atol=1e-5)
        mine = (bare.opacities * shown)[seen][here]
        np.testing.assert_allclose(mine, exact.opacities[exact.opacities > 0.05][there], atol=1e-5)
    packed(model, path, tmp_path / "a.pd4", cli)
    path.write_bytes(path.read_bytes()[:-400])
    with pytest.raises(DataError, match="a.4dgs: fourdgs cannot read it: "):
        read_model(str(path), 30)


# -- bad input ---------------------------------------------------------------------------------------------------------

NAN = np.float32(np.nan)


def test_gaussians_that_no_time_shows_right_are_left_out(tmp_path):
    """NaN, no bell, no rotation, a speed beyond all bounds: such rows are counted, and samples keep their rows."""
    checkpoint(tmp_path / "a", xyz=[[NAN, 0, 0]], scaling_t=[[-200.0]] * 2, rotation_r=[[0.0] * 4] * 3)
    changed = {"xyz": [[3e9, 0, 0]], "rot01": [[NAN, 0]] * 2, "motion": [[np.float16(np.inf)] * 10] * 3}
    (tmp_path / "b").write_bytes(splatv(**changed)[0])
    for name in "ab":
        with pytest.warns(DamageWarning, match="3 of 60 Gaussians are left out"):
            model = read_model(str(tmp_path / name), 30)
        assert sampled(model, name).means.shape[1] == 57


def test_a_rotation_that_passes_through_nothing_stays(tmp_path):
    still = {"rot01": [[1, 0]], "rot23": [[0, 0]], "omega": [[-2, 0, 0, 0]], "trbf": [[0, 1]]}
    (tmp_path / "a").write_bytes(splatv(**still)[0])
    np.testing.assert_array_equal(read_model(str(tmp_path / "a"), 30).splats(0.5).quats[0], [1, 0, 0, 0])


def test_an_environment_map_is_left_out_and_said(tmp_path):
    checkpoint(path := tmp_path / "chkpnt7.pth", sky=torch.zeros(3, 4, 4))
    with pytest.warns(DamageWarning, match="its environment map is left out"):
        read_model(str(path), 30)


def replaced(path: Path, place: int, value: object) -> None:
    """Replaces a part of a checkpoint."""
    parts, iteration = torch.load(path, weights_only=False)
    torch.save(((*parts[:place], value, *parts[place + 1 :]), iteration), path)


@pytest.mark.parametrize(
    "place, value, message",
    [
        (1, torch.zeros(60, 2), r"xyz has shape \(60, 2\), expected \(any, 3\)"),
        (1, None, "has no tensor xyz"),
        (14, torch.zeros(59, 1), r"scaling_t has shape \(59, 1\), expected \(60, 1\)"),
        (15, torch.zeros(0), r"rotation_r has shape \(0,\), expected \(60, 4\)"),
        (3, torch.zeros(60, 7, 3), "8 coefficients per colour, expected 16 for degree 3"),
        (3, torch.zeros(60, 0, 3), r"features_rest has shape \(60, 0, 3\), expected \(60, any, 3\)"),
        (1, torch.full((60, 3), torch.nan), "none of 60 Gaussians is finite"),
        (13, torch.full((60, 1), torch.nan), "none of 60 Gaussians is finite"),
        (0, 9, "has degrees and rot_4d .9, 2, True., expected 0 to 3, 0 to 2, and True or False"),
        (0, 3.0, "has degrees and rot_4d .3.0, 2, True., expected"),
        (0, torch.ones(2), "has degrees and rot_4d .array"),
        (18, None, "has degrees and rot_4d .3, None, True., expected"),
        (16, "yes", "has degrees and rot_4d .3, 2, 'yes'., expected"),
    ],
)
def test_broken_checkpoints_are_one_line(tmp_path, place, value, message):
    checkpoint(path := tmp_path / "chkpnt7.pth")
    replaced(path, place, value)
    with pytest.raises(DataError, match=message) as error, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read_model(str(path), 30)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_a_checkpoint_of_static_gaussians_is_told_from_others(tmp_path):
    torch.save((tuple(range(12)), 7), tmp_path / "chkpnt7.pth")
    with pytest.raises(DataError, match="a checkpoint of 12 parts, expected 19 as of 4DGS, or the PLY file of static"):
        read_model(str(tmp_path / "chkpnt7.pth"), 30)


def test_broken_splatv_files_are_one_line(tmp_path, monkeypatch, cli):
    monkeypatch.chdir(tmp_path)
    data, _ = splatv()
    size = int.from_bytes(data[4:8], "little")
    for name, changed, message in (
        ("cut", data[:-70], "a damaged .splatv file (it lists 3,904 bytes of Gaussians, and 3,834 are there)"),
        ("head", data[:9], "is a damaged .splatv file (Expecting value"),
        ("long", data[:4] + b"\xff" * 4 + data[8:], "is a damaged .splatv file ("),
        ("deep", data[:4] + (9000).to_bytes(4, "little") + b"[" * 9000, "is a damaged .splatv file"),
        ("none", data[:8] + b"[]".ljust(size) + data[8 + size :], "it lists 0 bytes of Gaussians, and 3,904 are there"),
        ("many", data.replace(b'"size": 3904', b'"size": 1e99'), "it lists 999,999,999"),
        ("void", data[: 8 + size].replace(b'"size": 3904', b'"size": 0000'), "is a damaged .splatv file ("),
        ("zero", data[: 8 + size].replace(b'"size": 3904', b'"size":    0'), "none of 0 Gaussians"),
        ("less", data.replace(b'"size": 3904', b'"size": -904'), "it lists -904 bytes"),
        ("list", data.replace(b'"splat"', b'"other"'), "it lists 3,904 bytes"),
        ("dark", data[: 8 + size] + bytes(len(data) - 8 - size), "none of 0 Gaussians"),
    ):
        Path(name).write_bytes(changed)
        _refused(cli, name, message)
