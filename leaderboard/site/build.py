"""Pages from records: what is on the site, and under which names."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from m3gn_bench.datasets.card import CARDS
from m3gn_bench.datasets.writer import write_bytes_atomically
from m3gn_bench.figures import save
from m3gn_bench.leaderboard.claims import render_claims
from m3gn_bench.leaderboard.figures import draw_board
from m3gn_bench.leaderboard.record import ResultRecord
from m3gn_bench.leaderboard.render import TRACKS, tracks_of
from m3gn_bench.leaderboard.site.board import board_rows, digits, groups_of
from m3gn_bench.leaderboard.site.markdown import Page, to_line, to_page
from m3gn_bench.leaderboard.site.rollouts import Rollouts
from m3gn_bench.leaderboard.summary import SOME, middle, titles
from m3gn_bench.stability import Stability
from m3gn_bench.study_page import draw, render
from m3gn_bench.tradeoff import TradeOff
from m3gn_bench.version import __version__

HERE = Path(__file__).parent
# Of these tracks no errors are drawn: ablations are compared in pairs, and the others say nothing about models.
NOT_DRAWN = ("ablations", "tuning", "smoke")


class Site:
    """A site that grows page by page in a folder; files that are not its own stay as they are.

    Args:
        folder: where it goes.
        pages: file name and title of all pages that the menu has.
        titles: of tasks by name.
    """

    def __init__(self, folder: Path, pages: Mapping[str, str], titles: Mapping[str, str]) -> None:
        self.folder, self.pages = folder, pages
        self.files: list[Path] = []
        self.templates = Environment(
            loader=FileSystemLoader(HERE / "templates"),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self.templates.filters |= {"micro": lambda value: digits(1e6 * value), "digits": digits}
        self.templates.globals |= {"pages": pages, "version": __version__, "titles": titles}

    def page(self, name: str, template: str, **values: Any) -> None:
        """Write a page; `values` are what its template names. Pages below another one name it as `parent`."""
        text = self.templates.get_template(template).render(
            **{"parent": name, "title": self.pages.get(name), **values}
        )
        self.write(name, text.encode())

    def write(self, name: str, content: bytes) -> None:
        """Write a file, whole or not at all."""
        write_bytes_atomically(self.folder / name, content)
        self.files.append(self.folder / name)

    def figure(self, name: str, figure: Any) -> str:
        """Write a figure (of matplotlib) and return its place on the site."""
        save(figure, self.folder / "figures" / name)
        self.files.append(self.folder / "figures" / name)
        return f"figures/{name}"


def build(
    folder: Path,
    records: Sequence[ResultRecord],
    studies: tuple[Sequence[TradeOff], Sequence[Stability]],
    rollouts: Sequence[Rollouts] | None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Write the whole site.

    Args:
        folder: where to.
        records: of the leaderboard.
        studies: of speed against accuracy, and of stability.
        rollouts: of the tasks that have any; None for a site without that page.
        on_progress: called with (done, total) while the table is made.

    Returns:
        All files.
    """
    pages = {
        "index.html": "Leaderboard",
        "curves.html": "Error curves",
        "findings.html": "Findings",
        "studies.html": "Speed and stability",
        "rollouts.html": "Rollouts",
        "datasets.html": "Datasets",
    }
    if rollouts is None:
        del pages["rollouts.html"]
    site = Site(folder, pages, titles(records))
    for path in sorted((HERE / "static").iterdir()):
        if rollouts is not None or path.name not in ("viewer.js", "rollouts.js"):
            site.write(path.name, path.read_bytes())
    _leaderboard(site, records, rollouts or (), on_progress)
    _curves(site, records)
    site.page("findings.html", "document.html", document=to_page(render_claims(records), {}))
    _studies(site, *studies)
    if rollouts is not None:
        _rollouts(site, rollouts)
    _datasets(site)
    return site.files


def _leaderboard(
    site: Site,
    records: Sequence[ResultRecord],
    rollouts: Sequence[Rollouts],
    on_progress: Callable[[int, int], None],
) -> None:
    rows = board_rows(records, on_progress)
    contexts: dict[str, set[int]] = {}
    for row in rows:
        contexts.setdefault(row.task + row.part, set()).add(row.context)
    site.page(
        "index.html",
        "leaderboard.html",
        rows=rows,
        boards={
            name + part: title + part
            for name, title in titles(records).items()
            for part in ("", SOME)
            if name + part in contexts
        },
        machines=sorted({machine for row in rows for machine in row.entry.seconds_per_prediction}),
        groups=groups_of(rows),
        tracks={name: to_line(TRACKS.get(name, "")) for name in tracks_of(records)},
        contexts=sorted({row.context for row in rows}),
        middles={name: middle(list(sizes)) for name, sizes in contexts.items()},
        watchable={(one.task.name, name): label for one in rollouts for name, label in one.models.items()},
    )


def _curves(site: Site, records: Sequence[ResultRecord]) -> None:
    figures = []
    for track in tracks_of(records):
        for name in titles(records) if track not in NOT_DRAWN else ():
            figure = draw_board(records, track, name)
            if figure is not None:
                figures.append((track, name, site.figure(f"errors-{track}-{name}.svg", figure)))
    site.page("curves.html", "curves.html", figures=figures)


def _studies(site: Site, tradeoffs: Sequence[TradeOff], stabilities: Sequence[Stability]) -> None:
    links = {}
    for study in tradeoffs:
        name = f"tradeoff-{study.task}.svg"
        links[f"studies/{name}"] = site.figure(name, draw(study))
    document = to_page(render(tradeoffs, stabilities), links) if tradeoffs or stabilities else None
    site.page("studies.html", "document.html" if document else "no_studies.html", document=document)


def _rollouts(site: Site, rollouts: Sequence[Rollouts]) -> None:
    shown = [one for one in rollouts if one.scripts]
    for one in shown:
        for script in one.scripts:
            site.write(f"rollouts/{script.name}.js", script.content)
    choices = [
        {
            "task": one.task.name,
            "title": one.task.title,
            "models": list(one.models.values()),
            "contexts": one.task.context_sizes,
            "trajectories": [{"name": s.name, "label": s.label} for s in one.scripts],
        }
        for one in shown
    ]
    site.page(
        "rollouts.html",
        "rollouts.html",
        choices=choices,
        notes=[note for one in rollouts for note in one.notes],
    )


def _datasets(site: Site) -> None:
    names = {path.name: f"dataset-{path.stem}.html" for path in sorted(CARDS.glob("*.md"))}
    cards: dict[str, Page] = {}
    for source, name in names.items():
        cards[name] = to_page((CARDS / source).read_text(encoding="utf-8"), names)
        site.page(
            name, "document.html", document=cards[name], title=cards[name].title, parent="datasets.html"
        )
    site.page("datasets.html", "datasets.html", cards=cards)
