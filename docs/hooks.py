"""Makes the documentation's site (see mkdocs.yml) of files that lie all over the repository.

Every page keeps its path in the repository, so that links between Markdown files are the same on the site. Links to
other files of the repository lead to the reference of their module, or else to pages that show them. The reference of
the command line is made from the commands themselves. Formulas become MathML, which browsers draw without a library.
"""

import html
import inspect
import posixpath
import re
import shutil
import tomllib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import click
from latex2mathml.converter import convert
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from m3gn_bench.cli import cli

ROOT = Path(__file__).parent.parent
# Where pages and the pictures on them are. What else they link to is found by itself.
PAGES = (
    "*.md",
    "docs/**/*.md",
    "datasets/cards/*.md",
    "leaderboard/*.md",
    "generators/meshes/*.md",
    "validation/README.md",
    "benchmarks/README.md",
)
MEDIA = ("docs/*.css", "docs/*.js", "docs/studies/*.svg", "leaderboard/figures/*")
LINK = re.compile(r"(?<=\]\()(?P<target>[^()\s#:]+)(?P<anchor>#[^()\s]*)?(?=\))")
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
REMOTE = re.compile(
    r'<(?:script|img|iframe)[^>]*\ssrc="https?:[^"]*"|<link[^>]*rel="(?:stylesheet|preconnect)"[^>]*https?:[^>]*'
)
REFERENCE = "reference/"
COMMANDS = REFERENCE + "commands.md"
PACKAGE = TemporaryDirectory(prefix="m3gn-bench-docs-")  # removed at exit
PARTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"]
references: dict[str, str] = {}  # the page of each module that has one, by its file


@event_priority(100)  # before mkdocstrings reads where the package is
def on_config(config: MkDocsConfig) -> None:
    """Put pages into the navigation that it does not name, and the package where mkdocstrings finds it."""
    named = set(_paths(config.nav))
    guides = next(section["Guides"] for section in config.nav or [] if "Guides" in section)
    guides += [page for page in sorted(_found("docs/*.md")) if page not in named]
    references.update((_source_of(path), path) for path in named if path.startswith(REFERENCE))
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [_package()]


def _paths(nav: Any) -> Iterator[str]:
    """All pages of a navigation."""
    if isinstance(nav, str):
        yield nav
    elif nav:
        for entry in nav.values() if isinstance(nav, dict) else nav:
            yield from _paths(entry)


def _found(*patterns: str) -> list[str]:
    """Paths of files, relative to the repository."""
    return [path.relative_to(ROOT).as_posix() for pattern in patterns for path in ROOT.glob(pattern)]


def _package() -> str:
    """A folder with the package as it is installed: in the repository its parts are folders beside each other."""
    for name, place in PARTS.items():
        target = Path(PACKAGE.name, *name.split("."))
        unneeded = shutil.ignore_patterns("__pycache__", "*.npz", "records", "checkpoints")
        shutil.copytree(ROOT / place, target, ignore=unneeded, dirs_exist_ok=True)
    return PACKAGE.name


def _source_of(reference: str) -> str:
    """The file of the module that a page of the reference describes."""
    package, _, module = reference.removeprefix(REFERENCE).removesuffix(".md").rpartition(".")
    return f"{PARTS.get(package, package)}/{module}.py"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The theme's files, the repository's pages and pictures, and pages that are made of something else."""
    kept = Files([file for file in files if file.src_dir != config.docs_dir])
    pages = _found(*PAGES)
    for path in [*pages, *_found(*MEDIA)]:
        kept.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    for path in _paths(config.nav):
        if path.startswith(REFERENCE):
            name = path.removeprefix(REFERENCE).removesuffix(".md")
            content = _commands() if path == COMMANDS else f"# {name}\n\n::: {name}\n"
            kept.append(File.generated(config, path, content=content))
    for page in pages:
        for match in LINK.finditer((ROOT / page).read_text()):
            path = _resolve(page, match["target"])
            shown = _page_of(path)
            if shown != path and kept.get_file_from_path(shown) is None:
                kept.append(File.generated(config, shown, content=_show(path)))
    return kept


def _resolve(page: str, target: str) -> str:
    """A link's target as a path in the repository."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), target))


def _page_of(path: str) -> str:
    """The page that shows a file or folder of the repository; the path itself if it is part of the site."""
    if (ROOT / path).is_dir():
        readme = f"{path}/README.md"
        return readme if (ROOT / readme).is_file() else f"{path}/index.md"
    if path in references:
        return references[path]
    if (ROOT / path).is_file() and path not in _found(*PAGES, *MEDIA):
        return f"{path}.md"
    return path


def _show(path: str) -> str:
    """A page with the content of a file, or of the files in a folder."""
    place = ROOT / path
    if place.is_file():
        return f"# {place.name}\n\n`{path}`\n\n{_source(place)}"
    parts = [f"# {place.name}\n\n`{path}`\n"]
    for file in sorted(place.iterdir()):
        if f"{path}/{file.name}" in _found(*PAGES):
            parts.append(f"- [{file.stem}]({file.name})")
        elif file.suffix in (".py", ".toml", ".json", ".jsonl"):
            parts.append(f"\n## {file.name}\n\n{_source(file)}")
    return "\n".join(parts)


def _source(file: Path) -> str:
    return f"````{file.suffix.removeprefix('.')}\n{file.read_text().rstrip()}\n````\n"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links to what is no page lead to the page that shows it."""
    source = page.file.src_uri

    def rewritten(match: re.Match[str]) -> str:
        path = _resolve(source, match["target"])
        shown = _page_of(path)
        if shown == path:
            return match[0]
        return posixpath.relpath(shown, posixpath.dirname(source) or ".") + (match["anchor"] or "")

    return LINK.sub(rewritten, markdown)


def on_page_content(content: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn formulas into MathML."""

    def drawn(match: re.Match[str]) -> str:
        is_block = match[2] == "["
        formula = convert(html.unescape(match[3]).strip(), display="block" if is_block else "inline")
        return f'<div class="formula">{formula}</div>' if is_block else formula

    return FORMULA.sub(drawn, content)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> None:
    """Refuse a page that loads something from elsewhere."""
    remote = REMOTE.search(output)
    if remote:
        raise PluginError(f"{page.file.src_uri} needs the network: {remote[0]}")


def _commands() -> str:
    """The reference of the command line."""
    context = click.Context(cli, info_name="m3gn-bench")
    return "\n".join(
        [
            "# Command line\n",
            "Exit codes: 0 fine, 1 something was found wrong, 2 could not run, 130 interrupted (run the same command "
            "again to go on). With `--json` a command prints one JSON object on standard output.\n",
            *_command(cli, context, 1),
        ]
    )


def _command(command: click.Command, context: click.Context, level: int) -> Iterator[str]:
    """What `--help` says of a command and of those below it, as Markdown."""
    if level > 1:
        usage = " ".join([context.command_path, *command.collect_usage_pieces(context)])
        yield f"{'#' * level} {context.command_path.removeprefix('m3gn-bench ')}\n"
        yield f"```text\n{usage}\n```\n"
        for paragraph in inspect.cleandoc(command.help or "").split("\n\n"):
            is_verbatim = paragraph.lstrip().startswith("\b")
            text = paragraph.lstrip("\b\n")
            yield f"```text\n{text}\n```\n" if is_verbatim else f"{_escaped(text)}\n"
        options = [option for option in command.params if isinstance(option, click.Option)]
        records = [record for option in options if (record := option.get_help_record(context))]
        rows = [f"| `{option}` | {_escaped(text)} |" for option, text in records]
        if rows:
            yield "\n".join(["| option | |", "| --- | --- |", *rows, ""])
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            found = command.get_command(context, name)
            if found is not None and not found.hidden:
                below = click.Context(found, info_name=name, parent=context)
                yield from _command(found, below, level + 1)


def _escaped(text: str) -> str:
    """Text of a help as Markdown that shows it as it is; code in backticks stays code."""
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(
        part if part.startswith("`") else re.sub(r"([\\*_<>\[\]|$])", r"\\\1", part) for part in parts
    )
