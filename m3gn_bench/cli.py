"""The command line. Exit codes: 0 fine, 1 something was found wrong, 2 could not run, 130 interrupted."""

import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import click

from m3gn_bench.console import DATA, JSON, Report, table
from m3gn_bench.dataset_commands import card, generate, info, reproduce, validate, view
from m3gn_bench.datasets.errors import BenchError
from m3gn_bench.export_commands import export
from m3gn_bench.import_commands import import_command
from m3gn_bench.leaderboard_commands import campaign, leaderboard
from m3gn_bench.model_commands import evaluate, profile, train
from m3gn_bench.report_commands import report_command
from m3gn_bench.study_commands import render_studies, stability, tradeoff
from m3gn_bench.version import __version__

# Modules that need torch or a simulator are imported inside the commands, so that --help stays instant.


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="m3gn-bench")
def cli() -> None:
    """Regenerate the M3GN benchmark's data, train models on it, and score them."""


def run(arguments: Sequence[str] | None = None) -> None:
    """Entry point: turns every error that a user can act on into one line and an exit code."""
    try:
        with _termination_interrupts():
            sys.exit(cli.main(args=arguments, prog_name="m3gn-bench", standalone_mode=False))
    except click.ClickException as error:
        error.show()
        sys.exit(2)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted; run the same command again", err=True)
        sys.exit(130)
    except BenchError as error:
        click.echo(f"error: {error}", err=True)
        sys.exit(2)
    except OSError as error:  # permissions, a full disk, a vanished folder
        click.echo(
            f"error: {error.strerror or error}{f': {error.filename}' if error.filename else ''}", err=True
        )
        sys.exit(2)


@contextmanager
def _termination_interrupts() -> Iterator[None]:
    """`timeout`, a batch system or a shutdown end a command as Ctrl-C does: temporary files go, workers end."""
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@cli.command("list")
@JSON
def list_command(as_json: bool) -> None:
    """Scenes, tasks, tiers, models and presets, with the number of parameters of each."""
    from m3gn_bench.datasets.schema import TIERS, tier_sizes
    from m3gn_bench.generators.scene import usable_scenes
    from m3gn_bench.model import PRESETS
    from m3gn_bench.published import published_parameters
    from m3gn_bench.sizes import parameter_counts
    from m3gn_bench.sources import usable_tasks

    used = usable_tasks()
    scenes: list[dict[str, Any]] = [
        {
            "name": scene.name,
            "version": scene.dataset_version,
            "frames": scene.frames,
            "sizes": scene.paper_sizes,
            "fidelities": list(scene.fidelities),
        }
        for scene in usable_scenes().values()
    ]
    tasks: list[dict[str, Any]] = [
        {
            "name": task.name,
            "title": task.title,
            "scene": task.scene,
            "frames": task.frames,
            "transitions": task.frames - 1,
            "dimension": task.dimension,
            "context_sizes": task.context_sizes,
            "tiers": {
                tier: {
                    split: scene.task_size(task.name, split, size)
                    for split, size in tier_sizes(tier, scene.paper_sizes).items()
                }
                for tier in TIERS
            },
        }
        for task, scene in used
    ]
    counts = parameter_counts([task for task, _ in used])
    models = [
        {
            "name": name,
            "preset": preset,
            "task": task,
            "parameters": count,
            "published_parameters": published_parameters(task, name, preset),
        }
        for (name, preset, task), count in counts.items()
    ]

    def shown_count(name: str, preset: str, task: str) -> str:
        published, count = published_parameters(task, name, preset), counts[name, preset, task]
        if published is None:
            return str(count)
        return f"{count} = paper" if published == count else f"{count}, paper {published}"

    Report(as_json).finish(
        {
            "scenes": scenes,
            "tasks": tasks,
            "tiers": list(TIERS),
            "presets": list(PRESETS),
            "models": models,
        },
        table(
            "Scenes",
            ["scene", "version", "frames", "paper tier (train/val/test)", "fidelities"],
            [
                [
                    s["name"],
                    s["version"],
                    s["frames"],
                    "/".join(map(str, s["sizes"].values())),
                    ", ".join(s["fidelities"]),
                ]
                for s in scenes
            ],
        ),
        table(
            "Tasks",
            ["task", "frames", "context sizes", *(f"{tier} (train/val/test)" for tier in TIERS)],
            [
                [
                    t["name"],
                    t["frames"],
                    ", ".join(map(str, t["context_sizes"])),
                    *("/".join(map(str, sizes.values())) for sizes in t["tiers"].values()),
                ]
                for t in tasks
            ],
        ),
        table(
            "Models: trainable parameters",
            ["model", "task", *PRESETS],
            [
                [name, task, *(shown_count(name, p, task) for p in PRESETS)]
                for name, task in dict.fromkeys((name, task) for name, _, task in counts)
            ],
        ),
    )


@cli.command()
@click.option("--self-test/--no-self-test", default=True, help="Simulate and predict, too (half a minute).")
@DATA
@JSON
def doctor(self_test: bool, data: Path, as_json: bool) -> None:
    """What is installed, what it can use, and whether it computes what it should; exit code 1 if not."""
    from m3gn_bench.doctor import examine

    report = Report(as_json)
    with report.progress("looking") as on_progress:
        findings = examine(data, self_test, on_progress)
    wrong = [finding for finding in findings if finding.state == "wrong"]
    report.finish(
        {"ok": not wrong, "findings": [finding.model_dump(mode="json") for finding in findings]},
        *(f"{f.part:12} {f.name:24} {f.state:8} {f.detail}" for f in findings),
        f"{len(wrong)} of {len(findings)} things are wrong" if wrong else "everything is fine",
    )
    sys.exit(1 if wrong else 0)


for command in (
    *(generate, validate, info, view, export, import_command, card, reproduce),
    *(train, evaluate, profile),
    *(tradeoff, stability, render_studies),
    *(campaign, leaderboard, report_command),
):
    cli.add_command(command)
