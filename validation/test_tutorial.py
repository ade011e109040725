"""The tutorial, carried out for real: its commands in an empty folder, and what it says one will see.

Only the installation is left out; the commands are those of the environment that runs the tests. All of them together
take a minute and a half.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from m3gn_bench.leaderboard.record import read_records

TUTORIAL = Path(__file__).parent.parent / "docs" / "tutorial.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[+-]?\d+)?")
DETERMINISTIC = 0.01  # simulations: solvers stop at a tolerance, and figures are rounded
TRAINED = 0.5  # training amplifies differences of rounding between processors and versions of torch
LEARNED = re.compile(
    r"^\| m3?gn |^(│ .*){8}|^validation error"
)  # on the board, in the table of `evaluate`, of `train`
DURATION = re.compile(r"^(steps .* in )[\d.]+( min)$|(\d)\.\d MB")


def blocks() -> list[tuple[str, str]]:
    """Language and content of the tutorial's blocks, in order, without the installation."""
    (first, installation), *others = BLOCK.findall(TUTORIAL.read_text())
    assert first == "bash"
    assert "pip install" in installation
    return others


def words(line: str) -> list[str]:
    """A line without what its columns' widths and the clock decide."""
    return DURATION.sub(r"\1\2\3", " ".join(line.split())).split()


def agree(shown: str, printed: str) -> bool:
    """Whether two lines say the same, up to differences that numbers may have."""
    if NUMBER.sub("#", " ".join(words(shown))) != NUMBER.sub("#", " ".join(words(printed))):
        return False
    tolerance = TRAINED if LEARNED.match(shown) else DETERMINISTIC
    pairs = zip(
        *(map(float, NUMBER.findall(" ".join(words(line)))) for line in (shown, printed)), strict=True
    )
    return all(there == pytest.approx(here, rel=tolerance) for here, there in pairs)


def carry_out(folder: Path) -> list[tuple[str, str, str]]:
    """What the tutorial runs in a folder, says is printed, and what was printed."""
    scripts = Path(sys.executable).parent
    environment = {name: value for name, value in os.environ.items() if name != "M3GN_BENCH_DATA"}
    environment["PATH"] = f"{scripts}{os.pathsep}{environment['PATH']}"
    programs = {"bash": ["bash", "-euo", "pipefail", "-c"], "python": [sys.executable, "-c"]}
    done: list[tuple[str, str, str]] = []
    for language, content in blocks():
        if language == "text":
            command, _, printed = done.pop()
            done.append((command, content, printed))
            continue
        ran = subprocess.run(
            [*programs[language], content],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
        )
        assert ran.returncode == 0, f"{content}\n{ran.stderr}"
        done.append((content, "", ran.stdout))
    return done


def test_does_what_it_says(tmp_path: Path) -> None:
    for command, shown, printed in carry_out(tmp_path):
        assert shown, f"the tutorial does not say what this prints: {command}"
        for line in shown.splitlines():
            assert any(agree(line, other) for other in printed.splitlines()), f"{line}\nnot in\n{printed}"

    assert (tmp_path / "models.png").read_bytes().startswith(b"\x89PNG")
    assert {path.name for path in tmp_path.iterdir()} == {"board", "data", "models.png", "plan.toml", "runs"}

    # The model learned: less than half the error of standing still, and less the more frames it sees.
    records = {record.model: record for record in read_records(tmp_path / "board")}
    trained, still = records["m3gn"].results, records["stand_still"].results
    assert all(ours.mse < theirs.mse / 2 for ours, theirs in zip(trained, still, strict=True))
    assert trained[0].mse > trained[1].mse > trained[2].mse


def test_has_about_ten_commands() -> None:
    commands = [line for language, content in blocks() for line in content.splitlines() if language == "bash"]
    assert sum(line.startswith("m3gn-bench ") for line in commands) <= 10


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("frames 51", "frames  51", True),
        ("frames 51", "frames 52", False),
        ("| stand_still | 1014 |", "| stand_still | 1030 |", False),
        ("| m3gn | 396 [178, 763] |", "| m3gn | 300 [150, 700] |", True),
        ("| m3gn | 396 |", "| m3gn | 800 |", False),
        ("steps 100 in 0.0 min", "steps 100 in 0.3 min", True),
    ],
)
def test_comparison(shown: str, printed: str, same: bool) -> None:
    assert agree(shown, printed) is same
