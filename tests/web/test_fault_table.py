"""The client under faults: what each scenario shows, random cuts, a crowd; and that these checks can fail."""

from __future__ import annotations

from dataclasses import replace

import fault_table
import pytest
from fault_table import File, crowd, digest, random_cuts, run, scenarios
from faulty import Fault
from strategies import make_scene

from pd4dgs_codec import decode, encode
from pd4dgs_codec.errors import DataError


@pytest.fixture(scope="module")
def file(scene_bytes) -> File:
    return File(scene_bytes)


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(fault_table, "STALL_SECONDS", 0.3)
    monkeypatch.setattr(fault_table, "SLUMP_SECONDS", 0.2)


def test_every_scenario_ends_as_it_must(file):
    rows = {scenario.name: run(file, scenario) for scenario in scenarios(file)}
    assert [name for name, row in rows.items() if not row.kept] == []
    whole = rows["nothing"]
    assert [shown[:2] for shown in whole.shown] == file.levels() and whole.sent == len(file.data)
    assert rows["another file after a cut"].changes == 1


def test_a_row_fails_if_a_wrong_scene_is_shown_or_the_end_is_another(file):
    scenario = scenarios(file)[0]
    assert run(file, scenario).kept
    for wrong in (
        replace(scenario, content=file.other),
        replace(scenario, expected=file.levels()[:-1]),
        replace(scenario, error=DataError),
        replace(scenario, faults=[Fault(status=404)]),
    ):
        assert not run(file, wrong).kept
    stranger = encode(make_scene(9, anchors=30), layers=2, effort=1)
    assert {shown[0] for shown in run(file, replace(scenario, content=stranger)).shown} == {"?"}


def test_digests_tell_every_array_apart(file):
    assert len(file.digests) == 6  # three levels of two files
    scene = decode(file.data)
    assert digest(scene) == digest(decode(file.data))
    feature = scene.feature.copy()
    feature[-1, -1] += 1
    assert digest(scene) != digest(replace(scene, feature=feature))


@pytest.mark.parametrize("cuts", [20, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_cuts_give_the_same_pictures(file, cuts):
    found = random_cuts(file, cuts)
    assert found.cuts >= cuts and found.wrong == 0
    strange = File(file.data)
    strange.digests = {}
    assert random_cuts(strange, 1).wrong == 1  # it can fail


@pytest.mark.parametrize("clients", [4, pytest.param(64, marks=pytest.mark.slow)])
def test_many_clients_at_once_get_every_byte(file, clients):
    found = crowd(file.data, clients)
    assert found.clients == clients and found.errors == []
