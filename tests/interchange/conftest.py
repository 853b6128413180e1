"""A scene to export, decoded from a file, as it is and with networks that do not see the view direction."""

import pytest
from tiny import sighted, trained_like_scene

from pd4dgs_codec.draw.player import Player
from pd4dgs_codec.format.decoder import decode
from pd4dgs_codec.format.encoder import encode
from pd4dgs_codec.scene import Scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return decode(encode(trained_like_scene(), layers=2, effort=1))


@pytest.fixture
def player(scene) -> Player:
    return Player(scene)


@pytest.fixture
def blind_player(scene) -> Player:
    """Its Gaussians are the same from everywhere."""
    return Player(sighted(scene))
