"""`pd4dgs-train --view`: shows the scene in the browser while it trains, served by viser.

Frames are rendered between two steps, in the trainer's own thread, so that none shows half an update. Without a viewer
a step costs one look-up in an empty table.
"""

from __future__ import annotations

import contextlib
import io
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from pd4dgs_codec.cli.common import TrainingProgress
from pd4dgs_codec.data.view import rotation_matrix, world_to_camera
from pd4dgs_codec.errors import RenderError, TrainError, required
from pd4dgs_codec.scene import Camera

if TYPE_CHECKING:
    from pd4dgs_codec.train.loop import Trainer

#: Only this machine can see the page.
HOST = "127.0.0.1"
#: Pixels of the longer side of a frame, while the camera moves and when it rests.
MOVING_PIXELS, RESTING_PIXELS = 320, 640
#: Rendering takes at most this share of the time, for any number of viewers.
SHARE = 0.25
#: Seconds between two frames of a resting camera.
REFRESH = 2.0
LEVELS = 3


@dataclass
class _Shown:
    """The last frame sent to a browser: its camera, level and time; whether it had full size; when it was sent."""

    what: tuple[Any, ...] = ()
    full: bool = False
    at: float = float("-inf")


@contextlib.contextmanager
def _own_pages_alone() -> Iterator[None]:
    """Makes viser servers that start in this block refuse connections from pages of other sites, since viser itself
    does not check origins."""
    from websockets.asyncio import server

    serve, own = server.serve, re.compile(rf"http://({re.escape(HOST)}|localhost)(:\d+)?")
    server.serve = partial(serve, origins=[None, own])  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]


class WatchedProgress(TrainingProgress):
    """Shows progress in the terminal, and the scene from each viewer's camera on a page."""

    def __init__(self, trainer: Trainer, port: int) -> None:
        """Raises DataError if viser is not installed, TrainError if the port cannot be used."""
        super().__init__()
        viser = required("viser", "watch", "pages of a training")
        try:
            with contextlib.redirect_stdout(io.StringIO()), _own_pages_alone():  # a banner; stdout is for results
                self.server = viser.ViserServer(host=HOST, port=port, label="pd4dgs-train", verbose=False)
        except (OSError, RuntimeError) as error:
            raise TrainError(f"--view {port}: cannot listen on this port: {error}") from None
        self.url = f"http://{HOST}:{self.server.get_port()}"
        self._shown: dict[int, _Shown] = {}
        self._next, self._rows, self._began = 0.0, -1, time.monotonic()
        data, gui = trainer.dataset, self.server.gui
        self._span = max(data.time_range[1] - data.time_range[0], 1e-3)
        eye = np.linalg.inv(data.camera.viewmat.astype(np.float64))
        middle = data.box.astype(np.float64).mean(axis=0)
        ahead = max(float(eye[:3, 2] @ (middle - eye[:3, 3])), data.near)
        self.server.scene.set_up_direction(data.up)
        self.server.initial_camera.position = tuple(eye[:3, 3])
        self.server.initial_camera.look_at = tuple(eye[:3, 3] + ahead * eye[:3, 2])
        self.server.initial_camera.up = data.up
        self.server.initial_camera.fov = float(2 * np.arctan(data.camera.height / 2 / data.camera.K[1, 1]))
        self.state = gui.add_markdown("starting")
        levels = [str(level) for level in range(LEVELS)]
        self.level = gui.add_dropdown("level", levels, initial_value=levels[-1])
        self.time: Any = gui.add_slider("time", min=0.0, max=1.0, step=0.001, initial_value=0.0)
        self.play = gui.add_checkbox("play", initial_value=False)
        self.curve: Any = None

    def update(self, trainer: Trainer, record: dict[str, Any]) -> None:
        super().update(trainer, record)
        clients = self.server.get_clients()
        if not clients:
            return
        now = time.monotonic()
        if now < self._next:
            return
        self._tell(trainer, record)
        for key, client in clients.items():
            with contextlib.suppress(RenderError, KeyError):  # a model that diverged; a browser that just left
                self._show(trainer, key, client)
        spent = time.monotonic() - now
        self._next = now + spent / SHARE
        self._shown = {key: shown for key, shown in self._shown.items() if key in clients}

    def close(self) -> None:
        super().close()
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    def _tell(self, trainer: Trainer, record: dict[str, Any]) -> None:
        """Shows the progress, and the PSNR curve if it has a new point."""
        loss = record.get("loss", float("nan"))
        total = f" of {trainer.total}" if trainer.total and not trainer.timed else ""
        lines = (f"step {trainer.iteration}{total}, {trainer.seconds:.0f} s", f"loss {loss:.4f}")
        self.state.content = "\n\n".join([*lines, f"{record['anchors']:,} anchors"])
        if len(trainer.curve) == self._rows or not trainer.curve:
            return
        self._rows = len(trainer.curve)
        steps = np.array([row["iteration"] for row in trainer.curve], np.float64)
        psnr = [
            np.array([(row["psnr"] + [np.nan] * LEVELS)[level] for row in trainer.curve]) for level in range(LEVELS)
        ]
        if self.curve is None:
            colors = ("#888888", "#3377cc", "#cc5533")
            series: list[Any] = [{"label": "step"}]
            series += [{"label": f"level {i}", "stroke": c} for i, c in enumerate(colors)]
            self.curve = self.server.gui.add_uplot(
                (steps, *psnr), tuple(series), title="PSNR dB", scales={"x": {"time": False}}, aspect=1.4
            )
        else:
            self.curve.data = (steps, *psnr)

    def _show(self, trainer: Trainer, key: int, client: Any) -> None:
        """Renders for one browser: small at once if its view changed, otherwise in full size every REFRESH seconds."""
        from pd4dgs_codec.model.picture import render_image
        from pd4dgs_codec.quality.image import to_uint8

        now = time.monotonic()
        if self.play.value:
            self.time.value = ((now - self._began) / self._span) % 1.0
        level, t = min(int(self.level.value), trainer.model.level), float(np.clip(self.time.value, 0, 1))
        eye = client.camera
        if not (eye.image_width and eye.image_height):  # a window without a picture, of which viser has no aspect
            return
        what = (tuple(eye.wxyz), tuple(eye.position), eye.fov, eye.aspect, level, t)
        shown = self._shown.setdefault(key, _Shown())
        moved = what != shown.what
        if not moved and shown.full and now - shown.at < REFRESH:
            return
        camera = camera_of(eye.wxyz, eye.position, eye.fov, eye.aspect, MOVING_PIXELS if moved else RESTING_PIXELS)
        client.scene.set_background_image(to_uint8(render_image(trainer.model, level, t, camera)), format="jpeg")
        self._shown[key] = _Shown(what, not moved, time.monotonic())


def camera_of(wxyz: Any, position: Any, fov: float, aspect: float, pixels: int) -> Camera:
    """Converts a browser's camera. wxyz: camera-to-world rotation as a quaternion, OpenCV axes; fov: vertical, radians;
    aspect: width over height; pixels: of the longer side."""
    rotation = rotation_matrix(np.asarray(wxyz) / max(float(np.linalg.norm(wxyz)), 1e-12))
    viewmat = world_to_camera(rotation.T, np.asarray(position, np.float64))
    width, height = max(1, round(pixels * min(aspect, 1.0))), max(1, round(pixels / max(aspect, 1.0)))
    focal = 0.5 * height / np.tan(0.5 * fov)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Camera(viewmat.astype(np.float32), K.astype(np.float32), width, height)
