"""`pd4dgs-train --view`: a browser's part is played by a socket that speaks viser's messages."""

import importlib.metadata
import sys
import time

import numpy as np
import pytest
from tiny import TINY, disc

from pd4dgs_codec.cli import watch
from pd4dgs_codec.cli.train import main
from pd4dgs_codec.cli.watch import RESTING_PIXELS, WatchedProgress, camera_of
from pd4dgs_codec.errors import DataError
from pd4dgs_codec.interchange.splats import quaternions
from pd4dgs_codec.model.picture import render_image
from pd4dgs_codec.train.config import TrainConfig
from pd4dgs_codec.train.loop import Trainer

WIDTH, HEIGHT, FOV = 64, 48, 0.9
PATIENCE = 60.0


@pytest.fixture(scope="module")
def dataset():
    return disc()


@pytest.fixture
def trainer(dataset):
    return Trainer(TrainConfig(preset="tiny", iterations=6), dataset, size=TINY)


@pytest.fixture
def watched(trainer):
    pytest.importorskip("viser")
    progress = WatchedProgress(trainer, 0)
    yield progress
    progress.close()


class Browser:
    """Looks from the data set's first camera."""

    def __init__(self, progress: WatchedProgress, view, height: int = HEIGHT):
        import msgspec
        from viser import _messages

        self.encode, self.messages, self.progress = msgspec.msgpack.encode, _messages, progress
        self.socket = connected(progress, max_size=None)
        eye = np.linalg.inv(view.viewmat.astype(np.float64))
        self.pose = tuple(quaternions(eye[None, :3, :3])[0].tolist()), tuple(eye[:3, 3].tolist())
        look_at = tuple(map(float, eye[:3, 3] + eye[:3, 2]))
        self.send(_messages.ViewerCameraMessage(*self.pose, FOV, 0.01, 100.0, height, WIDTH, look_at, (0.0, 0.0, 1.0)))
        wait_for(lambda: progress.server.get_clients())

    def send(self, message) -> None:
        self.socket.send(self.encode(message.as_serializable_dict()))

    def choose(self, handle, value) -> None:
        self.send(self.messages.GuiUpdateMessage(handle._impl.uuid, {"value": value}))
        wait_for(lambda: handle.value == value)


def connected(progress: WatchedProgress, **options):
    """The socket of a browser."""
    from websockets.sync.client import connect

    address, version = progress.url.replace("http", "ws"), importlib.metadata.version("viser")
    return connect(address, subprotocols=[f"viser-v{version}"], **options)


def wait_for(condition) -> None:
    end = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < end, "nothing came"
        time.sleep(0.01)


def _step(trainer, progress) -> None:
    progress._next = 0.0  # as if the time that drawing may take had come
    progress.update(trainer, trainer.learner.step())


def test_a_browser_sees_the_scene_from_its_camera(watched, trainer, dataset, monkeypatch):
    monkeypatch.setattr(watch, "REFRESH", float("inf"))
    sent = []
    browser = Browser(watched, dataset.train[0])
    client = next(iter(watched.server.get_clients().values()))
    monkeypatch.setattr(client.scene, "set_background_image", lambda image, format: sent.append(image))
    _step(trainer, watched)
    _step(trainer, watched)
    assert max(sent[0].shape) < max(sent[1].shape) == RESTING_PIXELS  # small at once, then in full
    camera = camera_of(*browser.pose, FOV, WIDTH / HEIGHT, RESTING_PIXELS)
    np.testing.assert_allclose(camera.viewmat, dataset.train[0].viewmat, atol=1e-5)
    assert 2 * np.arctan(camera.height / 2 / camera.K[1, 1]) == pytest.approx(FOV)
    expected = render_image(trainer.model, trainer.model.level, 0.0, camera)
    assert np.abs(sent[1] / 255 - expected).max() <= 0.5 / 255 + 1e-3
    _step(trainer, watched)
    assert len(sent) == 2  # it rests, and the next picture is not due
    browser.choose(watched.time, 0.5)
    browser.choose(watched.level, "0")
    _step(trainer, watched)
    expected = render_image(trainer.model, 0, 0.5, camera_of(*browser.pose, FOV, WIDTH / HEIGHT, sent[2].shape[1]))
    assert np.abs(sent[2] / 255 - expected).max() <= 0.5 / 255 + 1e-3
    assert watched.state.content.startswith("step 4 of 6")


def test_a_page_of_another_site_sees_nothing(watched):
    """A site can open a socket to this machine in its visitor's browser, which says whose page it is."""
    from websockets.exceptions import InvalidStatus

    for origin in ("http://evil.example", "null", "http://127.0.0.1.evil.example", "https://localhost"):
        with pytest.raises(InvalidStatus) as refused:
            connected(watched, origin=origin)
        assert refused.value.response.status_code == 403, origin
    connected(watched, origin=watched.url).close()


def test_nothing_is_drawn_while_nobody_looks(watched, trainer, monkeypatch):
    for name in ("_show", "_tell"):
        monkeypatch.setattr(watched, name, lambda *_: pytest.fail("drawn for nobody"))
    for _ in range(3):
        _step(trainer, watched)


def test_a_window_without_height_does_not_end_the_run(watched, trainer, dataset):
    Browser(watched, dataset.train[0], height=0)
    _step(trainer, watched)


def test_curves_grow_with_the_run(watched, trainer, dataset):
    Browser(watched, dataset.train[0])
    trainer.curve = [{"iteration": 1, "seconds": 1.0, "psnr": [20.0, 21.0, 22.0]}]
    _step(trainer, watched)
    trainer.curve.append({"iteration": 2, "seconds": 2.0, "psnr": [23.0]})
    _step(trainer, watched)
    steps, *levels = watched.curve.data
    assert list(steps) == [1, 2] and list(levels[0]) == [20, 23] and np.isnan(levels[2][1])


def test_being_watched_changes_no_bit(dataset, trainer, watched):
    other = Trainer(trainer.config, dataset, size=TINY)
    Browser(watched, dataset.train[0])
    for _ in range(6):
        _step(trainer, watched)
        other.learner.step()
    mine, others = (t.model.state_dict() for t in (trainer, other))
    assert all(bool((mine[name] == others[name]).all()) for name in mine)


def test_without_viser_it_is_one_line(trainer, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(DataError, match=r"need the package viser.*\[watch\]"):
        WatchedProgress(trainer, 0)


def test_a_view_that_cannot_open_keeps_the_earlier_log(tmp_path, monkeypatch, shared_dataset):
    monkeypatch.setitem(sys.modules, "viser", None)
    (tmp_path / "m.jsonl").write_text("{}\n")
    options = ["--log", str(tmp_path / "m.jsonl"), "-f", "--iterations", "2", "--preset", "tiny", "--view", "0"]
    assert main([str(shared_dataset), "-o", str(tmp_path / "m.pt"), *options]) == 1
    assert (tmp_path / "m.jsonl").read_text() == "{}\n"


def test_the_command_says_where_to_look(tmp_path, capsys, shared_dataset):
    pytest.importorskip("viser")
    options = ["--preset", "tiny", "--iterations", "2", "--view", "0"]
    assert main([str(shared_dataset), "-o", str(tmp_path / "m.pt"), *options]) == 0
    told = capsys.readouterr()
    assert "watch the training at http://127.0.0.1:" in told.err and told.out == ""
