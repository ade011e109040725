"""Findings, figures and pictures of the board: what they say follows from the records."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from m3gn_bench.checkpoint import Checkpoint, ConfigRecord, load_checkpoint
from m3gn_bench.cli import run
from m3gn_bench.data import load_cases
from m3gn_bench.leaderboard import claims
from m3gn_bench.leaderboard.campaign import Job, carry_out, read_plan
from m3gn_bench.leaderboard.claims import Claim, Comparison, render_claims
from m3gn_bench.leaderboard.figures import draw_board
from m3gn_bench.leaderboard.pictures import agreement_of_neighbours, draw_latents, draw_overlays
from m3gn_bench.leaderboard.record import ContextResult, ResultRecord, checkpoint_folder, write_record
from m3gn_bench.m3gn import M3GN
from m3gn_bench.metrics import TrajectoryErrors
from m3gn_bench.tasks import TASKS, get_task

KEYS = tuple(f"test_{n:05}" for n in range(12))


def made_up(
    model: str, error: float, *, seed: int = 0, keys: tuple[str, ...] = KEYS, variant: str = ""
) -> ResultRecord:
    """A record on Sheet Deformation whose error is so large, and halves with every context size."""
    rng = np.random.default_rng(seed)
    results = []
    for number, context in enumerate(get_task("sheet_deformation").context_sizes):
        mse = error / 2**number * rng.uniform(0.8, 1.2, len(keys))
        per_timestep = np.repeat(mse[:, None], 51 - context, 1)
        results.append(ContextResult.from_errors(context, TrajectoryErrors(mse, mse, per_timestep)))
    checkpoint = Checkpoint(
        task="sheet_deformation",
        seed=seed,
        config=ConfigRecord(model_name=model, preset="compact", model={}, training={}),
        config_hash="",
        steps=1,
        best_step=1,
        minutes=1.0,
        validation_error=1.0,
        dataset_hash="",
        device="cpu",
        threads=1,
        package_version="0",
    )
    return ResultRecord(
        track="compact",
        task="sheet_deformation",
        model=model,
        preset="compact",
        variant=variant,
        seed=seed,
        parameters=1,
        tier="paper",
        split="test",
        dataset_version="1.0",
        dataset_hash="",
        keys=keys,
        trajectory_hashes=("0",) * len(keys),
        package_version="0",
        commit=None,
        machine="",
        evaluation_device="cpu",
        evaluation_threads=1,
        evaluation_seconds=1.0,
        checkpoint=checkpoint,
        ships=False,
        results=tuple(results),
    )


def verdict_of(monkeypatch: pytest.MonkeyPatch, records: list[ResultRecord], *comparisons: Comparison) -> str:
    """The verdict that the page has for a finding of these comparisons."""
    monkeypatch.setattr(claims, "CLAIMS", (Claim("It is so", "somewhere", comparisons),))
    page = render_claims(records)
    (row,) = [line for line in page.splitlines() if line.startswith("| It is so |")]
    return row.split("|")[2].strip()


def below(better: str, worse: str, **options: float) -> Comparison:
    return Comparison("compact", "sheet_deformation", better, worse, **options)  # type: ignore[arg-type]


def rows(seeds: int = 3, **errors: float) -> list[ResultRecord]:
    """Models of such errors, with so many seeds each."""
    return [made_up(model, error, seed=seed) for model, error in errors.items() for seed in range(seeds)]


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [(1.0, 2.0, "reproduced"), (2.0, 1.0, "not reproduced"), (1.0, 1.001, "undecided")],
)
def test_verdicts(monkeypatch: pytest.MonkeyPatch, first: float, second: float, verdict: str) -> None:
    assert verdict_of(monkeypatch, rows(a=first, b=second), below("a", "b")) == verdict


@pytest.mark.parametrize(
    ("first", "verdict"), [(1.0, "reproduced"), (1.1, "undecided"), (1.3, "not reproduced")]
)
def test_no_worse_allows_a_margin(monkeypatch: pytest.MonkeyPatch, first: float, verdict: str) -> None:
    """Equal errors are what "as good as" means, and what is clearly worse is not."""
    comparison = below("a", "b", margin=0.1)
    assert verdict_of(monkeypatch, rows(a=first, b=1.0), comparison) == verdict
    assert verdict_of(monkeypatch, rows(a=1.0, b=1.0), below("a", "b")) == "undecided"


@pytest.mark.parametrize(("second", "verdict"), [(11.0, "reproduced"), (5.0, "not reproduced")])
def test_a_negative_margin_asks_for_more(
    monkeypatch: pytest.MonkeyPatch, second: float, verdict: str
) -> None:
    """An order of magnitude, say."""
    records = rows(a=1.0, b=second)
    assert verdict_of(monkeypatch, records, below("a", "b", margin=-0.9)) == verdict
    assert verdict_of(monkeypatch, records, below("a", "b")) == "reproduced"


def test_seeds_that_differ_as_much_as_models_decide_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The lowest of one are below the highest of the other; the bootstrap alone would take sides."""
    records = [made_up("a", error, seed=seed) for seed, error in enumerate((1.0, 1.2, 2.0))]
    records += [made_up("b", error, seed=seed) for seed, error in enumerate((1.8, 3.0, 5.0))]
    assert claims.probability_of_less(*claims.entries(records, "compact", "sheet_deformation"), 5) > 0.975
    assert verdict_of(monkeypatch, records, below("a", "b")) == "undecided"


def test_what_holds_in_part_or_has_no_record(monkeypatch: pytest.MonkeyPatch) -> None:
    records = rows(a=1.0, b=2.0, c=0.5)
    mixed = verdict_of(monkeypatch, records, below("a", "b"), below("a", "c"))
    assert mixed == "mixed (1 contradicted, 1 holds)"
    partly = verdict_of(monkeypatch, rows(a=1.0, b=2.0, c=1.001), below("a", "b"), below("a", "c"))
    assert partly == "reproduced in part (1 holds, 1 undecided)"
    missing = verdict_of(monkeypatch, records, below("a", "c"), below("a", "d"))
    assert missing == "not measured yet (1 contradicted, 1 not measured yet)"
    assert verdict_of(monkeypatch, rows(2, a=1.0, b=2.0), below("a", "b")) == "not measured yet"
    assert verdict_of(monkeypatch, records) == "not testable here"


def test_of_several_machines_the_one_that_says_least_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    records = [
        r.model_copy(update={"machine": machine, "evaluation_seconds": seconds})
        for r, machine, seconds in zip(
            rows(2, a=1.0, b=1.0), ["one", "two"] * 2, [1.0, 1.0, 4.0, 1.2], strict=True
        )
    ]
    faster = below("a", "b", time="faster")
    assert verdict_of(monkeypatch, records, faster) == "undecided"
    assert verdict_of(monkeypatch, records, below("b", "a", time="faster")) == "not reproduced"
    assert verdict_of(monkeypatch, records, below("a", "b", time="no slower")) == "reproduced"
    assert verdict_of(monkeypatch, records, below("b", "a", time="no slower")) == "not reproduced"


def test_what_is_faster(monkeypatch: pytest.MonkeyPatch) -> None:
    records = rows(a=1.0, b=1.0)
    slow = [r.model_copy(update={"evaluation_seconds": 2.0}) if r.model == "b" else r for r in records]
    faster = below("a", "b", time="faster")
    assert verdict_of(monkeypatch, slow, faster) == "reproduced"
    assert verdict_of(monkeypatch, slow, below("b", "a", time="faster")) == "not reproduced"
    assert verdict_of(monkeypatch, records, faster) == "undecided"
    elsewhere = [r.model_copy(update={"machine": "another"}) if r.model == "b" else r for r in slow]
    assert verdict_of(monkeypatch, elsewhere, faster) == "not measured yet"
    # Of two machines, only one has a time of each.
    both = [
        r.model_copy(update={"machine": machine, "evaluation_device": device, "evaluation_seconds": seconds})
        for r, machine, device, seconds in zip(
            [records[0], records[1], records[3], records[4]],
            ["one", "two", "one", "two"],
            ["cpu", "cuda", "cuda", "cpu"],
            [3.0, 1.0, 1.0, 1.0],
            strict=True,
        )
    ]
    assert verdict_of(monkeypatch, both, faster) == "not measured yet"
    threads = [r.model_copy(update={"evaluation_threads": 2}) for r in slow]
    assert verdict_of(monkeypatch, threads, faster) == "not measured yet"


def test_contexts_and_common_trajectories(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model against itself at another context size, and rows that share only some trajectories."""
    # Seeds differ far more than contexts do, but each of them is better with more context.
    records = [made_up("a", error, seed=seed) for seed, error in enumerate((1.0, 4.0, 16.0))]
    records += [made_up("b", 3200.0, seed=seed, keys=KEYS[3:9], variant="some") for seed in range(3)]
    assert verdict_of(monkeypatch, records, below("a", "a", context=10, worse_context=2)) == "reproduced"
    assert verdict_of(monkeypatch, records, below("a", "a", context=2, worse_context=10)) == "not reproduced"
    assert verdict_of(monkeypatch, records, below("a", "b (some)")) == "reproduced"


def test_findings_name_what_exists() -> None:
    """Every row that a finding looks for is planned, so that none stays unmeasured by a slip of the pen."""
    planned = {
        (
            run.track,
            run.task,
            f"{run.config.model_name} ({run.variant})" if run.variant else run.config.model_name,
        )
        for name in ("compact", "ablations")
        for run in read_plan(Path(claims.__file__).parent / "plans" / f"{name}.toml")
    }
    for claim in claims.CLAIMS:
        assert claim.remark or (claim.comparisons and not claim.verdict)
        for comparison in claim.comparisons:
            for row in (comparison.better, comparison.worse):
                assert (comparison.track, comparison.task, row) in planned, (claim.finding, row)
            sizes = TASKS[comparison.task].context_sizes
            assert {comparison.context, comparison.worse_context} <= {*sizes, None}


def test_figures_show_the_recorded_numbers() -> None:
    records = [made_up("m3gn", 1.0, seed=seed) for seed in (0, 1)] + [made_up("mgn", 2.0)]
    figure = draw_board(records, "compact", "sheet_deformation")
    assert isinstance(figure, Figure)
    over_context, over_time = figure.axes
    (line,) = [c for c in over_context.containers if c.get_label() == "mgn"]
    expected = [result.mse for result in records[-1].results]
    assert line[0].get_ydata() == pytest.approx(expected)
    assert over_time.lines[1].get_ydata() == pytest.approx([records[-1].results[1].mse] * 46)
    assert draw_board(records, "compact", "deformable_block") is None


def test_neighbours_agree_where_what_is_alike_is_close() -> None:
    rng = np.random.default_rng(0)
    values = rng.integers(0, 9, 200).astype(float)
    near = values[:, None] + 0.1 * rng.normal(size=(200, 3))
    assert agreement_of_neighbours(near, values) > 0.98
    assert abs(agreement_of_neighbours(rng.normal(size=(200, 3)), values)) < 0.2


def test_pictures_of_trained_models(smoke_file: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(
        'track = "compact"\ntier = "smoke"\n[[runs]]\ntasks = ["sheet_deformation"]\nmodels = ["m3gn", "mgn"]\n'
        'preset = "smoke"\nsteps = 2\nshipped_seeds = [0]\n'
    )
    outcomes = [carry_out(Job(run, smoke_file, tmp_path / "runs")) for run in read_plan(plan)]
    for outcome in outcomes:
        outcome.keep(tmp_path)
    records = [outcome.record for outcome in outcomes if outcome.record is not None]
    task = get_task("sheet_deformation")
    overlays = draw_overlays(records, task, smoke_file, "smoke", tmp_path)
    assert [axes.get_title() for axes in overlays.axes[:2]] == ["m3gn", "mgn"]
    model, _ = load_checkpoint(checkpoint_folder(task.name, "m3gn", "smoke", home=tmp_path))
    assert isinstance(model, M3GN)
    latents = draw_latents(model, load_cases(smoke_file, task, "test", "smoke"), 5)
    assert len(latents.axes[0].collections[0].get_offsets()) == 4


def test_pages_are_written_and_checked(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """By the command, for a board elsewhere; a changed record makes the pages out of date."""
    write_record(made_up("m3gn", 1.0), tmp_path)
    for arguments, code in (([], 0), (["--check"], 0)):
        with pytest.raises(SystemExit) as stop:
            run(["leaderboard", "render", "--home", str(tmp_path), "--json", *arguments])
        assert (stop.value.code or 0) == code
        assert json.loads(capsys.readouterr().out)["up_to_date"]
    assert (tmp_path / "figures" / "sheet_deformation.svg").is_file()
    assert "overlay" not in (tmp_path / "LEADERBOARD.md").read_text()
    for late in (
        lambda: write_record(made_up("mgn", 2.0), tmp_path),
        lambda: (tmp_path / "figures" / "overlay-sheet_deformation.png").touch(),
    ):
        late()
        with pytest.raises(SystemExit) as stop:
            run(["leaderboard", "render", "--home", str(tmp_path), "--check"])
        assert stop.value.code == 1
        with pytest.raises(SystemExit):
            run(["leaderboard", "render", "--home", str(tmp_path)])
    assert "(figures/overlay-sheet_deformation.png)" in (tmp_path / "LEADERBOARD.md").read_text()
