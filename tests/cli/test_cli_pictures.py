"""render and eval."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from tiny import TINY, write_views

from pd4dgs_codec import decode, render
from pd4dgs_codec.data.dataset import load
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.format.info import info
from pd4dgs_codec.model import checkpoint
from pd4dgs_codec.model.config import PRESETS
from pd4dgs_codec.model.model import from_scene
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.quality import perceptual
from pd4dgs_codec.quality.evaluate import TEMPORAL_FRAMES, evaluate
from pd4dgs_codec.quality.image import mpsnr, ssim, to_uint8
from pd4dgs_codec.quality.levels import load_levels
from pd4dgs_codec.quality.perceptual import Distance, Perceptual

WIDTH, HEIGHT = 32, 24  # of the scene's camera and of the dataset's pictures


def test_eval_states_quality_and_bytes_per_level(cli, scene_pd4, shared_dataset):
    result = cli("eval", scene_pd4, shared_dataset, "--json")
    assert result.code == 0
    report = result.json
    assert report["masked"] is False and report["split"] == "test" and report["views"] == 1
    assert isinstance(report["baseline_mean_image_psnr"], float)
    ends = [row["end"] for row in cli("info", scene_pd4, "--json").json["layers"]]
    assert [row["cumulative_bytes"] for row in report["levels"]] == ends
    assert [row["anchors"] for row in report["levels"]] == [40, 50, 60]
    for row in report["levels"]:
        assert 0 < row["mpsnr"] < 60 and -1 <= row["mssim"] <= 1 and row["decode_seconds"] > 0


def test_eval_says_which_pictures_are_missing(cli, scene_pd4, tmp_path):
    (write_views(tmp_path / "set") / "000.png").unlink()
    result = cli("eval", scene_pd4, tmp_path / "set", "--level", 0)
    assert "note: views left out, as their picture is missing (1): 000.png" in result.error_lines


def test_eval_averages_the_views_of_each_levels_own_prefix(scene_pd4, shared_dataset):
    data, dataset = scene_pd4.read_bytes(), load(str(shared_dataset), holdout=2)
    end = info(data)["layers"][1]["end"]
    rows = evaluate(load_levels(data[:end], 1), dataset)["levels"]
    model = from_scene(decode(data, max_layer=1))
    images = [render_image(model, 1, v.time, v.camera) for v in dataset.test]
    expected = np.mean([mpsnr(image, v.image, v.mask) for image, v in zip(images, dataset.test, strict=True)])
    assert len(images) == 3 and [row["level"] for row in rows] == [0, 1]
    assert rows[1]["mpsnr"] == pytest.approx(expected, abs=1e-9)


def test_eval_of_checkpoint_and_pipe(cli, model_pt, scene_pd4, shared_dataset):
    levels = cli("eval", model_pt, shared_dataset, "--json").json["levels"]
    assert [row["cumulative_bytes"] for row in levels] == [None] * 3
    piped = cli("eval", "-", shared_dataset, "--json", "--level", 1, stdin=scene_pd4.read_bytes()).json["levels"]
    assert [row["level"] for row in piped] == [0, 1]
    # what quantisation may cost on this scene
    assert piped[1]["mpsnr"] == pytest.approx(levels[1]["mpsnr"], abs=0.5)


def test_eval_measures_what_moves_where_cameras_stand_still(cli, scene_pd4):
    """Against the region found from the truth at hand, with the pictures that render writes."""
    source = "synthetic:flyby?size=32x32&frames=4"
    report = cli("eval", scene_pd4, source, "--json", "--level", 1).json
    views, (*_, level) = load(source).test, load_levels(scene_pd4, 1)
    scores, shares = [], []
    for view in views:
        truth = np.stack([v.image for v in views if v.camera_id == view.camera_id]).astype(int)
        region = (np.ptp(truth, axis=0) > 16).any(axis=2)
        scores.append(mpsnr(level.picture(view.camera, view.time), view.image, region))
        shares.append(region.mean())
    assert report["levels"][1]["moving_mpsnr"] == pytest.approx(np.mean(scores))
    assert 0 < report["moving_share"] == pytest.approx(np.mean(shares))
    shown = cli("eval", scene_pd4, source, "--level", 0).out.decode()
    assert "moving dB" in shown and f"views of fixed cameras ({100 * np.mean(shares):.1f} %)" in shown


@pytest.fixture
def transparent(dataset):
    """A dataset whose pictures show the background alone."""
    for picture in dataset.glob("*.png"):
        Image.fromarray(np.zeros((HEIGHT, WIDTH, 4), np.uint8)).save(picture)
    return dataset


@pytest.mark.parametrize("given", [None, "0,0.6,1"])
def test_truth_and_scene_have_the_background_of_the_file_or_the_option(cli, scene, tmp_path, transparent, given):
    file = tmp_path / "green.pd4"
    file.write_bytes(encode(replace(scene, info=replace(scene.info, background=(0.0, 1.0, 0.0))), effort=1))
    behind, options = (0.0, 1.0, 0.0), ["--level", 0, "--json"]
    if given:
        behind, options = (0.0, 0.6, 1.0), [*options, "--background", given]
    (view,), level = load(str(transparent)).test, load_levels(file, 0)[-1]
    level.model.background = behind
    truth = np.broadcast_to(np.float32(behind), (HEIGHT, WIDTH, 3))
    expected = mpsnr(level.picture(view.camera, view.time), truth)
    assert cli("eval", file, transparent, *options).json["levels"][0]["mpsnr"] == pytest.approx(expected)
    done = cli("render", file, "-o", tmp_path / "a.png", "--data", transparent, "--side-by-side", *options)
    assert done.code == 0
    sheet = np.asarray(Image.open(tmp_path / "a.png"))[-HEIGHT:]
    assert (sheet[:, -WIDTH:] == np.rint(255 * truth)).all()
    np.testing.assert_array_equal(sheet[:, :WIDTH], np.rint(255 * level.picture(view.camera, view.time)))


def test_a_model_keeps_the_background_that_it_is_trained_on(cli, tmp_path, transparent, monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", TINY)
    options = ("--preset", "tiny", "--iterations", 1, "--background", "0,0.5,1")
    assert cli("train", transparent, "-o", tmp_path / "m.pt", *options).code == 0
    assert checkpoint.load(tmp_path / "m.pt")[0].info.background == (0, 0.5, 1)
    assert cli("encode", tmp_path / "m.pt", "-o", tmp_path / "m.pd4", "--effort", 1).code == 0
    assert decode((tmp_path / "m.pd4").read_bytes()).info.background == (0, 0.5, 1)
    assert cli("eval", tmp_path / "m.pd4", transparent, "--background", "red").code == 2


def test_eval_by_the_protocol_of_3dgs(cli, scene_pd4, monkeypatch):
    """No masks, one LPIPS-VGG a picture; the masked metrics stay in the JSON."""

    def vgg():
        return perceptual.Distance("LPIPS-VGG", "by hand", lambda a, b: np.abs(a - b).max())

    source = "synthetic:local?size=32x24&frames=4"
    options = ("--protocol", "3dgs", "--level", 0)
    monkeypatch.setattr(perceptual, "_lpips", lambda *_, **__: vgg())
    report, plain = (cli("eval", scene_pd4, source, *o, "--json").json for o in (options, options[2:]))
    (row,), (usual,), level = report["levels"], plain["levels"], load_levels(scene_pd4, 0)[0]
    pairs = [(level.picture(v.camera, v.time), v.image) for v in load(source).test]
    assert row["psnr"] == pytest.approx(np.mean([mpsnr(*pair) for pair in pairs])) != row["mpsnr"]
    assert row["ssim"] == pytest.approx(np.mean([ssim(*pair) for pair in pairs]))
    assert row["lpips_vgg"] == pytest.approx(np.mean([vgg()(*pair) for pair in pairs]))
    assert set(row) - set(usual) == {"psnr", "ssim", "lpips_vgg"} and row["mssim"] == usual["mssim"]
    text = cli("eval", scene_pd4, source, *options).out.decode()
    assert "protocol 3dgs" in text and text.splitlines()[1].split()[1:6] == ["PSNR", "dB", "moving", "dB", "SSIM"]
    assert "LPIPS-VGG: by hand" in text and "t-:" not in text


def test_eval_of_the_first_bytes(cli, scene_pd4, shared_dataset):
    end = cli("info", scene_pd4, "--json").json["layers"][1]["end"]
    levels = cli("eval", scene_pd4, shared_dataset, "--json", "--max-bytes", end + 5).json["levels"]
    assert levels[-1]["cumulative_bytes"] == end and [row["level"] for row in levels] == [0, 1]
    assert cli("eval", scene_pd4, shared_dataset, "--max-bytes", 100).code == 1


def test_eval_without_held_out_views_says_so(cli, scene_pd4, shared_dataset):
    result = cli("eval", scene_pd4, shared_dataset, "--holdout", 0, "--level", 0)
    assert result.code == 0 and "training views" in result.err and b"6 training views" in result.out


def test_eval_adds_perceptual_distances_and_names_the_absent(cli, scene_pd4, shared_dataset, monkeypatch):
    distance = Distance("MAE", "by hand", lambda a, b: np.abs(a - b).mean(axis=2))
    loaded = Perceptual({"mae": distance}, {"lpips": "it is not here"})
    monkeypatch.setattr("pd4dgs_codec.quality.perceptual.load_perceptual", lambda names: loaded)
    command = ("eval", scene_pd4, shared_dataset, "--level", 1)
    result = cli(*command, "--perceptual", "--json")
    assert "lasts 1 s" in result.error_lines[0]  # the scene 2 s
    assert result.error_lines[1:] == ["no lpips: it is not here"]
    assert result.json["perceptual"]["absent"] == loaded.absent
    (view,), level = load(str(shared_dataset)).test, load_levels(scene_pd4, 1)[-1]
    row = result.json["levels"][1]
    assert row["mmae"] == distance(level.picture(view.camera, view.time), view.image, view.mask)
    frames = [level.picture(view.camera, t) for t in np.linspace(0, 1, TEMPORAL_FRAMES)]
    assert row["t_mae"] == pytest.approx(distance.temporal(frames)) and row["t_mae"] > 0
    assert result.json["levels"][0]["t_mae"] == 0  # level 0 stands still
    assert not any("lpips" in key for key in row)

    lines = cli(*command, "--perceptual").out.decode().splitlines()
    assert "mMAE" in lines[1] and "t-MAE" in lines[1] and f"{row['t_mae']:.5f}" in lines[3].split()
    plain = cli(*command, "--json").json
    assert "perceptual" not in plain and set(row) - set(plain["levels"][1]) == {"mmae", "t_mae"}


def test_render_dataset_views_as_the_renderer_sees_them(cli, scene_pd4, shared_dataset, tmp_path):
    options = ("--data", shared_dataset, "--split", "train", "--max-layer", 1, "--json")
    result = cli("render", scene_pd4, "-o", tmp_path / "out" / "%02d.png", *options)
    assert result.code == 0 and result.json["frames"] == 5 and result.json["levels"] == [1]
    view = load(str(shared_dataset)).train[2]
    level = load_levels(scene_pd4, 1)[-1]
    expected = to_uint8(level.picture(view.camera, view.time))
    assert np.array_equal(np.asarray(Image.open(tmp_path / "out" / "02.png")), expected)
    assert len(list((tmp_path / "out").iterdir())) == 5


def test_render_own_camera_to_gif_and_one_picture(cli, scene_pd4, tmp_path):
    assert cli("render", scene_pd4, "-o", tmp_path / "a.gif", "--frames", 5, "--orbit", 60).code == 0
    movie = Image.open(tmp_path / "a.gif")
    assert movie.n_frames == 5 and movie.size == (WIDTH, HEIGHT)
    assert cli("render", scene_pd4, "-o", tmp_path / "a.png", "--frames", 1, "--downscale", 2).code == 0
    assert Image.open(tmp_path / "a.png").size == (WIDTH // 2, HEIGHT // 2)


def test_a_picture_at_a_time_and_films_of_a_length(cli, scene_pd4, tmp_path):
    for name, time in (("first.png", 0), ("late.png", 0.75)):
        done = cli("render", scene_pd4, "-o", tmp_path / name, "--time", time, "--level", 1, "--json")
        assert done.code == 0 and done.json["frames"] == 1 and done.json["levels"] == [1]
        scene = decode(scene_pd4, max_layer=1)
        expected = to_uint8(render(scene, scene.info.camera, time))
        assert np.array_equal(np.asarray(Image.open(tmp_path / name)), expected)
    film = tmp_path / "film.gif"
    done = cli("render", scene_pd4, "-o", film, "--duration", "1.5s", "--fps", 8)
    assert done.code == 0 and f"{film}: 12 frames of 32x24, 1.5 s, level 2" in done.err


def test_side_by_side_holds_all_levels_and_the_truth(cli, scene_pd4, shared_dataset, tmp_path):
    options = ("--data", shared_dataset, "--side-by-side", "--json")
    report = cli("render", scene_pd4, "-o", tmp_path / "%d.png", *options).json
    assert report["levels"] == [0, 1, 2] and report["outputs"] == 1
    sheet = np.asarray(Image.open(tmp_path / "0.png"))
    truth = np.asarray(Image.open(shared_dataset / "004.png"))
    assert np.array_equal(sheet[-HEIGHT:, -WIDTH:], truth)
    assert sheet.shape[1] == 4 * WIDTH + 3 * 4


def test_side_by_side_in_one_picture_has_a_row_per_view(cli, scene_pd4, tmp_path):
    """Three of eleven views, evenly spread."""
    source = "synthetic:flyby?size=32x32&frames=11"
    options = ("--data", source, "--split", "train", "--side-by-side", "--frames", 3)
    assert cli("render", scene_pd4, "-o", tmp_path / "sheet.png", *options, "--json").json["outputs"] == 1
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    rows = np.split(sheet, 3)
    for row, i in zip(rows, (1, 5, 9), strict=True):
        assert np.array_equal(row[-32:, -32:], load(source).train[i].image)


def test_render_mp4(cli, scene_pd4, tmp_path):
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    assert cli("render", scene_pd4, "-o", tmp_path / "a.mp4", "--frames", 7, "--fps", 10).code == 0
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "a.mp4"))
    assert frames == 7 and seconds == pytest.approx(0.7, abs=0.11)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mp4"]


def test_mp4_without_ffmpeg_is_said_before_rendering(cli, scene_pd4, tmp_path, monkeypatch):
    def absent():
        raise RuntimeError("No ffmpeg exe could be found")

    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.setattr("imageio_ffmpeg.get_ffmpeg_exe", absent)
    result = cli("render", scene_pd4, "-o", tmp_path / "a.mp4")
    assert result.code == 1 and "imageio-ffmpeg" in result.err and list(tmp_path.iterdir()) == []
