"""The doctor finds what is missing, and what is wrong."""

import json
import shutil
import sys
from collections import namedtuple
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import pytest

from m3gn_bench import doctor
from m3gn_bench.cli import run
from m3gn_bench.generators import objects, scene, sheet_deformation
from m3gn_bench.generators.errors import GeneratorError


def states(findings: list[doctor.Finding]) -> dict[str, str]:
    return {finding.name: finding.state for finding in findings}


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(["doctor", "--no-self-test", "--data", str(tmp_path / "data"), "--json"])
    outcome = json.loads(capsys.readouterr().out)
    assert (stop.value.code or 0, outcome["ok"]) == (0, True)
    parts = {finding["part"] for finding in outcome["findings"]}
    assert {"machine", "library", "device", "disk", "mesh", "leaderboard"} <= parts
    assert not (tmp_path / "data").exists()


def test_a_missing_extra_is_advice_and_a_missing_library_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    def installed(name: str) -> str:
        if name in ("newton", "h5py"):
            raise PackageNotFoundError(name)
        return "0.1" if name == "torch" else version(name)

    monkeypatch.setattr(doctor, "version", installed)
    found = list(doctor.libraries())
    assert {name for name, state in states(found).items() if state == "wrong"} == {"h5py", "torch"}
    assert "0.1 is installed, <2.14,>=2.4 is needed" in next(f.detail for f in found if f.name == "torch")
    (advice,) = [finding for finding in found if finding.name == "newton"]
    assert "pip install 'm3gn-bench[newton]'" in advice.detail


def test_what_cannot_be_looked_at_is_one_line_among_the_others(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "torch", None)
    found = doctor.examine(tmp_path, self_test=False, on_progress=lambda done, total: None)
    (line,) = [finding for finding in found if finding.part == "doctor"]
    assert (line.name, line.state) == ("devices", "wrong")
    assert "ModuleNotFoundError" in line.detail
    assert {"library", "mesh", "leaderboard"} <= {finding.part for finding in found}


def test_a_full_disk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    usage = namedtuple("usage", "free")
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage(free=1e9))
    (found,) = doctor.disk(tmp_path / "not" / "made" / "yet")
    assert (found.name, found.state) == (str(tmp_path), "missing")


def test_a_changed_mesh_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    original = objects.load_object

    def load(name: str) -> objects.SoftBody:
        if name == "bunny":
            raise GeneratorError("bunny is not what it was")
        return original(name)

    monkeypatch.setattr(objects, "load_object", load)
    found = states(list(doctor.meshes()))
    assert found.pop("bunny") == "wrong"
    assert set(found.values()) == {"fine"}


def test_a_wrong_simulation_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in set(scene.OWN_SCENES) - {"deformable_block", "sheet_deformation"}:
        monkeypatch.delitem(scene.OWN_SCENES, name)
    assert set(states(list(doctor.simulations())).values()) == {"fine"}
    monkeypatch.setattr(sheet_deformation, "THICKNESS", 2.01)
    assert states(list(doctor.simulations())) == {"deformable_block": "fine", "sheet_deformation": "wrong"}
