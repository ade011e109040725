"""The web site: complete in its folder, true to the records, and alive in a browser."""

import base64
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from click.testing import CliRunner
from test_claims import made_up

from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.cli import cli, run
from m3gn_bench.data import load_cases
from m3gn_bench.generators.scene import get_scene
from m3gn_bench.leaderboard.campaign import Job, carry_out, read_plan
from m3gn_bench.leaderboard.record import checkpoint_folder, read_records, write_record
from m3gn_bench.leaderboard.site.board import board_rows
from m3gn_bench.leaderboard.site.build import build
from m3gn_bench.leaderboard.site.markdown import to_line, to_page
from m3gn_bench.leaderboard.site.rollouts import (
    LARGEST,
    Rollouts,
    choose,
    is_closed,
    kept_frames,
    pack,
    runnable,
)
from m3gn_bench.tasks import TASKS, get_task

TASK = get_task("sheet_deformation")
RECORDED = Path(__file__).parent.parent / "docs" / "studies"
STUDIES = ("tradeoff-deformable_block.json", "stability-deformable_block.json")
PLAN = """
track = "compact"
tier = "smoke"
[[runs]]
tasks = ["sheet_deformation"]
models = ["m3gn", "mgn"]
preset = "smoke"
steps = 2
shipped_seeds = [0]
"""
VOID = {"area", "br", "col", "hr", "img", "input", "link", "meta", "circle", "line"}


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory, smoke_file: Path) -> Path:
    """A leaderboard: two models that were trained for two steps and ship, and made-up records around them."""
    folder = tmp_path_factory.mktemp("board")
    (folder / "plan.toml").write_text(PLAN)
    for planned in read_plan(folder / "plan.toml"):
        outcome = carry_out(Job(planned, smoke_file, folder / "runs"))
        assert outcome.error is None
        outcome.keep(folder)
    # A board compares like with like.
    data = {"preset": "smoke", "tier": "smoke", "dataset_version": get_scene(TASK.scene).dataset_version}
    for model, error, seed in (
        ("egno", 3e-4, 0),
        ("mango", 2e-5, 0),
        ("mango", 3e-5, 1),
        ("stand_still", 1e-1, 0),
    ):
        write_record(made_up(model, error, seed=seed).model_copy(update=data), folder)
    write_record(made_up("mgn_mp", 1e-6).model_copy(update={"track": "ablations"}), folder)
    return folder


@pytest.fixture(scope="module")
def report(home: Path, smoke_file: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the command says of the site that it has made."""
    folder = tmp_path_factory.mktemp("site")
    studies = folder / "studies"
    studies.mkdir()
    for name in STUDIES:
        shutil.copy(RECORDED / name, studies)
    arguments = [
        "report",
        "-o",
        folder / "site",
        "--home",
        home,
        "--studies",
        studies,
        "--tier",
        "smoke",
        "--json",
    ]
    result = CliRunner().invoke(cli, [*map(str, arguments), "--data", str(smoke_file.parent)])
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)


@pytest.fixture(scope="module")
def site(report: dict[str, Any]) -> Path:
    return Path(report["start"]).parent


# -- pages ---------------------------------------------------------------------------------------------------


class Elements(HTMLParser):
    """All elements of a page, each with its attributes and the text inside it."""

    def __init__(self, page: Path | str) -> None:
        super().__init__()
        self.all: list[tuple[str, dict[str, str], list[str]]] = []
        self.inside: list[tuple[str, dict[str, str], list[str]]] = []
        self.feed(page.read_text() if isinstance(page, Path) else page)
        self.close()
        assert self.inside == [], "elements that are never closed"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        element = (tag, {name: value or "" for name, value in attrs}, [])
        self.all.append(element)
        if tag not in VOID:
            self.inside.append(element)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.inside.pop()[0] == tag

    def handle_data(self, data: str) -> None:
        for _, _, texts in self.inside:
            texts.append(data)

    def of(self, *tags: str) -> list[tuple[dict[str, str], str]]:
        """Attributes and text of all elements of these kinds."""
        return [(attributes, "".join(texts).strip()) for tag, attributes, texts in self.all if tag in tags]


def pages(site: Path) -> dict[str, Elements]:
    return {path.name: Elements(path) for path in sorted(site.glob("*.html"))}


def test_the_command_says_what_it_made(report: dict[str, Any], home: Path) -> None:
    assert report["records"] == len(read_records(home))
    assert report["studies"] == len(STUDIES)
    assert sum(Path(file).stat().st_size for file in report["files"]) == report["bytes"]
    assert report["rollouts"]["sheet_deformation"]["models"] == ["m3gn", "mgn"]
    assert report["notes"] == []  # errors are those on record


def test_every_link_leads_somewhere(site: Path) -> None:
    found = pages(site)
    assert {"index.html", "curves.html", "findings.html", "studies.html", "rollouts.html"} <= set(found)
    assert sum(name.startswith("dataset-") for name in found) == 5
    anchors = {name: {a["id"] for _, a, _ in page.all if "id" in a} for name, page in found.items()}
    for name, page in found.items():
        targets = [a[key] for _, a, _ in page.all for key in ("href", "src") if key in a]
        assert "style.css" in targets
        for target in targets:
            file, _, anchor = target.partition("#")
            if not target.startswith(("https://", "data:,")):
                assert (site / (file or name)).is_file(), f"{name} points to {target}"
            if anchor and file in ("", *found) and file != "rollouts.html":
                assert anchor in anchors[file or name], f"{name} points to {target}"


def test_nothing_is_loaded_from_elsewhere(site: Path) -> None:
    for page in pages(site).values():
        for tag, attributes, _ in page.all:
            loaded = attributes.get("src") or (attributes.get("href", "") if tag == "link" else "")
            assert not re.match(r"(?:\w+:)?//|\w+:(?!,)", loaded), loaded
    for path in (*site.glob("*.css"), *site.glob("*.js")):
        assert not re.search(
            r"https?:|url\(|@import|fetch\(|import\(|XMLHttpRequest|WebSocket", path.read_text()
        )


def test_pages_are_accessible(site: Path) -> None:
    for name, page in pages(site).items():
        assert len(page.of("h1")) == len(page.of("main")) == len(page.of("nav")) == 1, name
        assert page.of("html")[0][0]["lang"] == "en"
        assert page.of("title")[0][1].endswith("m3gn-bench")
        assert len(page.of("table")) == len(page.of("caption"))
        assert all(caption for _, caption in page.of("caption"))
        assert all(a.get("scope") in ("row", "col") for a, _ in page.of("th"))
        assert all(a.get("alt") for a, _ in page.of("img"))
        assert len(page.of("select", "input")) == len(page.of("label"))
        ids = [a["id"] for _, a, _ in page.all if "id" in a]
        assert len(ids) == len(set(ids))


def test_numbers_are_those_of_the_records(site: Path, home: Path) -> None:
    page = (site / "index.html").read_text()
    shown = {}
    for row in re.findall(r"<tr data-task.*?</tr>", page, re.DOTALL):
        elements = Elements(row)
        ((place, _),) = elements.of("tr")
        ((_, model),) = elements.of("th")
        cells = [float(a["data-value"]) for a, _ in elements.of("td") if "data-value" in a]
        shown[place["data-task"], place["data-track"], model, cells[0]] = (cells, elements.of("td"))
    records = read_records(home)
    assert len(shown) == 6 * 3  # rows of the board, context sizes
    for record in records:
        seeds = [r for r in records if (r.track, r.model) == (record.track, record.model)]
        for result in record.results:
            cells, texts = shown[record.task, record.track, record.model, result.context]
            results = [found for seed in seeds if (found := seed.result(result.context))]
            mean = np.mean([found.mse for found in results])
            assert cells[1] == pytest.approx(mean, rel=1e-8)
            assert cells[2] <= cells[1]
            assert cells[3] == pytest.approx(np.mean([found.mse_free_nodes for found in results]), rel=1e-8)
            assert len(seeds) in cells
            assert record.parameters in cells
            (text,) = {text for a, text in texts if a.get("data-value") == repr(cells[1])}
            assert float(text) == pytest.approx(1e6 * mean, rel=5e-3)


def test_findings_and_studies_are_those_of_the_pages(site: Path) -> None:
    findings = (site / "findings.html").read_text()
    assert '<td class="verdict none">not measured yet</td>' in findings
    assert "do not edit" not in findings
    studies = (site / "studies.html").read_text()
    assert (site / "figures" / "tradeoff-deformable_block.svg").is_file()
    assert 'src="figures/tradeoff-deformable_block.svg"' in studies
    record = json.loads((RECORDED / STUDIES[1]).read_text())
    assert all(cell["cell"] in studies for cell in record["cells"])


def test_what_records_say_is_text(tmp_path: Path) -> None:
    """Names come from other people's records."""
    record = made_up("m3gn", 1.0).model_copy(update={"variant": "<script>alert(1)</script>"})
    build(tmp_path, [record], ([], []), [])
    page = (tmp_path / "index.html").read_text()
    assert "alert(1)" in page
    assert "<script>alert" not in page
    assert "No checkpoint can be shown" in (tmp_path / "rollouts.html").read_text()


def column(site: Path, name: str) -> list[str]:
    """The texts of a column of the leaderboard."""
    table = (site / "index.html").read_text().partition('<table id="board"')[2].partition("</table>")[0]
    cells = [text for _, text in Elements(f"<table{table}</table>").of("th", "td")]
    columns = table.count('<th scope="col"')
    return cells[columns + cells.index(name) :: columns]


def test_a_time_with_several_threads_is_left_out(tmp_path: Path) -> None:
    several = made_up("mgn", 2.0).model_copy(update={"evaluation_threads": 2})
    build(tmp_path, [made_up("m3gn", 1.0), several], ([], []), None)
    times = zip(column(tmp_path, "model"), column(tmp_path, "prediction [ms]"), strict=True)
    assert {model: time != "" for model, time in times} == {"m3gn": True, "mgn": False}
    build(tmp_path, [several], ([], []), None)
    assert "prediction [ms]" not in (tmp_path / "index.html").read_text()


def test_times_of_different_machines_are_apart(tmp_path: Path) -> None:
    """For they cannot be compared."""
    records = [
        made_up("m3gn", 1.0, seed=seed).model_copy(update={"machine": machine, "evaluation_seconds": seconds})
        for seed, machine, seconds in ((0, "slow", 3.0), (1, "fast", 1.0), (2, "fast", 2.0))
    ]
    build(tmp_path, [*records, made_up("mgn", 2.0).model_copy(update={"machine": "slow"})], ([], []), None)
    predictions = len(records[0].keys) * len(records[0].results)
    models = column(tmp_path, "model")
    for machine, expected in (("slow", {"m3gn": 3.0, "mgn": 1.0}), ("fast", {"m3gn": 1.0, "mgn": None})):
        times = column(tmp_path, f"prediction [ms], {machine}")
        for model, time in zip(models, times, strict=True):
            seconds = expected[model]
            assert time == ("" if seconds is None else f"{1e3 * seconds / predictions:.3g}")


def test_the_device_of_training_is_named(tmp_path: Path) -> None:
    """Minutes of a GPU are others; what does not learn takes none of any."""
    records = []
    for model, device, minutes in (("mgn", "cuda", 0.5), ("m3gn", "cpu", 9.0), ("stand_still", "cuda", 0.0)):
        record = made_up(model, 1.0)
        trained = record.checkpoint.model_copy(update={"device": device, "minutes": minutes})
        records.append(record.model_copy(update={"checkpoint": trained}))
    build(tmp_path, records, ([], []), None)
    shown = dict(zip(column(tmp_path, "model"), column(tmp_path, "training [min]"), strict=True))
    assert shown == {"mgn": "0.5 of cuda", "m3gn": "9", "stand_still": "0"}


def test_what_is_of_some_materials_is_apart(tmp_path: Path) -> None:
    """Nor ranked with the others, whatever its errors."""
    materials = {"youngs_modulus": (10.0,)}
    some = [
        made_up("m3gn", 0.5, variant="soft", keys=("test_00000", "test_00001")),
        made_up("mgn", 5.0, variant="soft", keys=("test_00000", "test_00001", "test_00002")),
    ]
    records = [*(one.model_copy(update={"materials": materials}) for one in some)]
    records += [made_up("mgn", 2.0), made_up("m3gn", 1.0)]
    rows = [row for row in board_rows(records) if row.context == 5]
    assert [(row.entry.label, row.part) for row in rows] == [
        ("m3gn", ""),
        ("mgn", ""),
        ("m3gn (soft)", ", some materials"),
        ("mgn (soft)", ", some materials"),
    ]
    for ends in (rows[:2], rows[2:]):
        low, _, high = zip(*(row.places for row in ends), strict=True)
        assert (min(low), max(high)) == pytest.approx((0, 100))
    build(tmp_path, records, ([], []), None)
    page = Elements(tmp_path / "index.html")
    options = [text for a, text in page.of("option") if a["value"].startswith("sheet_deformation")]
    assert options == ["Sheet Deformation", "Sheet Deformation, some materials"]
    assert column(tmp_path, "task") == [name for name in options for _ in range(6)]
    about = [" ".join(text.split()) for a, text in page.of("li") if "data-task" in a]
    for text, name, number in zip(about, options, (len(records[2].keys), "2 or 3"), strict=True):
        assert text.startswith(f"{name}, track compact: {number} test trajectories of tier paper")


def test_records_of_a_task_that_is_not_installed_are_shown(tmp_path: Path) -> None:
    build(tmp_path, [made_up("m3gn", 1.0).model_copy(update={"task": "elsewhere"})], ([], []), None)
    assert set(column(tmp_path, "task")) == {"elsewhere"}
    assert (tmp_path / "figures" / "errors-compact-elsewhere.svg").exists()


def test_an_empty_board_has_pages_too(tmp_path: Path) -> None:
    build(tmp_path, [], ([], []), None)
    assert "There are no records yet" in (tmp_path / "index.html").read_text()
    assert "There are no records of these studies" in (tmp_path / "studies.html").read_text()
    assert not (tmp_path / "rollouts.html").exists()
    assert all("rollouts.html" not in path.read_text() for path in tmp_path.glob("*.html"))


def test_markdown_becomes_accessible_html() -> None:
    page = to_page(
        "# Title\n\nFirst *words*.\n\n<!-- hidden -->\n## Part\n\n<b>raw</b> [in](a.md), [out](b.md), and "
        "([gone](c.md)).\n\n"
        "| a | b |\n| --- | --: |\n| x | holds |\n\n## Part\n\n| | |\n|---|---|\n| y | 1 |\n",
        {"a.md": "a.html"},
    )
    body = str(page.body)
    assert (page.title, page.lead) == ("Title", "First words.")
    assert page.sections == (("part", "Part"), ("part--2", "Part"))
    assert "hidden" not in body
    assert "gone" not in body
    assert '&lt;b&gt;raw&lt;/b&gt; <a href="a.html">in</a>, out, and.' in body
    assert "<caption>Part, by a</caption>" in body
    assert '<th scope="row">x</th>' in body
    assert 'class="verdict good">holds</td>' in body
    assert body.count("<thead>") == 1


def test_a_line_has_no_links() -> None:
    text = "As [pace.jsonl](plans/pace.jsonl) says ([plan](plans/a.toml)), *not* <b>."
    assert to_line(text) == "As pace.jsonl says, <em>not</em> &lt;b&gt;."


@pytest.mark.parametrize("missing", ["jinja2", "markdown_it", "matplotlib", "adjustText"])
def test_the_extra_is_named(
    missing: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(SystemExit) as stop:
        run(["report", "-o", str(tmp_path / "site")])
    assert stop.value.code == 2
    assert "pip install 'm3gn-bench[report]'" in capsys.readouterr().err
    assert not (tmp_path / "site").exists()


def test_unknown_tier(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        run(["report", "-o", str(tmp_path), "--tier", "huge"])
    assert stop.value.code == 2
    assert "known: paper, quick, smoke" in capsys.readouterr().err


# -- board and rollouts --------------------------------------------------------------------------------------


def test_rows_are_sorted_and_placed() -> None:
    records = [
        made_up(model, error, seed=seed)
        for model, error in (("mgn", 4.0), ("m3gn", 1.0))
        for seed in range(3)
    ]
    rows = board_rows([*records, made_up("egno", 2.0)])
    assert [row.entry.label for row in rows[:3]] == ["m3gn", "egno", "mgn"]
    assert [row.context for row in rows] == [2, 2, 2, 5, 5, 5, 10, 10, 10]
    low, mean, high = zip(*(row.places for row in rows[:3]), strict=True)
    assert (min(low), max(high)) == pytest.approx((0, 100))
    assert list(mean) == sorted(mean)
    assert rows[0].probability is None
    assert rows[1].probability is None  # of one seed
    assert rows[2].probability == 0.0


def script_of(site: Path, name: str) -> dict[str, Any]:
    text = (site / "rollouts" / f"{name}.js").read_text()
    return json.loads(text.removeprefix(f'rollouts["{name}"] = ').removesuffix(";\n"))


def unpacked(text: str, scene: dict[str, Any]) -> np.ndarray:
    """Positions [frames, nodes, 3]."""
    values = np.frombuffer(base64.b64decode(text), "<i2") * scene["step"]
    return values.reshape(-1, scene["nodes"], 3)


def test_rollouts_hold_what_models_predict(
    site: Path, home: Path, smoke_file: Path, report: dict[str, Any]
) -> None:
    names = report["rollouts"]["sheet_deformation"]["trajectories"]
    assert len(names) == 3
    assert sum((site / "rollouts" / f"{name}.js").stat().st_size for name in names) < 2e6
    scene = script_of(site, names[1])
    key = names[1].removeprefix("sheet_deformation-")
    case = next(c for c in load_cases(smoke_file, TASK, "test", "smoke") if c.keys == (key,))
    assert scene["frames"] == list(range(51))
    assert unpacked(scene["truth"], scene) == pytest.approx(case.positions.numpy(), abs=0.51 * scene["step"])
    records = {record.model: record for record in read_records(home) if record.ships}
    assert {(p["model"], p["context"]) for p in scene["predictions"]} == {
        (model, context) for model in records for context in TASK.context_sizes
    }
    for prediction in scene["predictions"]:
        record, context = records[prediction["model"]], prediction["context"]
        model, _ = load_checkpoint(checkpoint_folder(TASK.name, record.model, "smoke", home=home))
        with torch.inference_mode():
            expected = model.predict(case.context(context)).numpy()
        found = unpacked(prediction["positions"], scene)
        assert not prediction["cut"]
        assert found == pytest.approx(expected, abs=0.51 * scene["step"])
        assert prediction["mse"] == record.mse_over(context, (key,))
        result = record.result(context)
        assert result is not None
        assert prediction["mean_mse"] == result.mse


def test_easy_typical_and_hard_trajectories_are_chosen() -> None:
    record = made_up("m3gn", 1.0)
    result = record.result(5)
    assert result is not None
    ordered = [record.keys[i] for i in np.argsort(result.trajectory_mse)]
    assert choose(record, record.keys, 5) == {
        ordered[0]: "easiest",
        ordered[6]: "typical",
        ordered[-1]: "hardest",
    }
    assert choose(record, [ordered[3], ordered[2], "test_99999"], 5) == {
        ordered[2]: "easiest",
        ordered[3]: "hardest",
    }
    assert choose(record, [], 5) == {}


def test_what_is_not_on_record_is_not_shown(home: Path) -> None:
    records = read_records(home)
    version = get_scene(TASK.scene).dataset_version
    found, left_out = runnable(records, TASK, version, home)
    assert [one.label for one in found] == ["m3gn", "mgn"]
    assert left_out == []
    assert "dataset version" in runnable(records, TASK, "0.9", home)[1][0]
    assert "no checkpoint in" in runnable(records, TASK, version, home / "elsewhere")[1][1]
    other = records[0].checkpoint.model_copy(update={"best_step": 99})
    changed = [record.model_copy(update={"checkpoint": other}) for record in records]
    assert "not the one that was recorded" in runnable(changed, TASK, version, home)[1][0]


def test_every_shipped_checkpoint_can_be_watched(home: Path, tmp_path: Path) -> None:
    """Also where several are of the same model."""
    (record,) = (r for r in read_records(home) if r.model == "m3gn" and r.ships)
    labels = {record.name: "m3gn-smoke-s0", "m3gn-smoke-s1": "m3gn-smoke-s1"}
    build(tmp_path, [record], ([], []), [Rollouts(TASK, labels, ())])
    assert column(tmp_path, "rollouts") == ["watch"] * 3
    assert f"rollouts.html#{TASK.name}/m3gn-smoke-s0/5" in (tmp_path / "index.html").read_text()


def test_pictures_are_of_the_board_that_is_named(home: Path, smoke_file: Path, tmp_path: Path) -> None:
    """With its own checkpoints, of whatever preset."""
    options = ["--home", home, "-o", tmp_path, "--tier", "smoke", "--data", smoke_file.parent, "--json"]
    result = CliRunner().invoke(cli, ["leaderboard", "pictures", *map(str, options)])
    assert result.exit_code == 0, result.output
    files = [tmp_path / f"{kind}-sheet_deformation.png" for kind in ("overlay", "latent")]
    assert json.loads(result.stdout)["files"] == [str(file) for file in files]
    assert all(file.stat().st_size for file in files)


def test_numbers_are_packed() -> None:
    values = np.array([[0.5, -0.25, 1e3]])
    packed = np.frombuffer(base64.b64decode(pack(values, 1e-3)), "<i2")
    assert packed.tolist() == [500, -250, LARGEST]
    for task in TASKS.values():
        frames = kept_frames(task.frames)
        assert len(frames) <= 60
        assert (frames[0], frames[-1]) == (0, task.frames - 1)
    tetrahedron = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
    assert is_closed(tetrahedron)
    assert not is_closed(tetrahedron[1:])
    assert not is_closed(np.concatenate([tetrahedron[:3], [[0, 1, 2]]]))


# -- in a browser --------------------------------------------------------------------------------------------

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
in_a_browser = pytest.mark.skipif(
    CHROMIUM is None, reason="no chromium on PATH (Debian: apt-get install chromium)"
)
BEFORE = """<script>
window.problems = [];
addEventListener("error", (event) => problems.push(event.message || `${event.target.src} failed`), true);
addEventListener("unhandledrejection", (event) => problems.push(String(event.reason)));
</script>"""
AFTER = """<script>
const change = (element, value) => {
  element.value = value;
  element.dispatchEvent(new Event(element.type === "range" ? "input" : "change", { bubbles: true }));
};
const wait = async (condition) => {
  for (let i = 0; i < 200 && !condition(); i++) await new Promise((done) => setTimeout(done, 20));
};
addEventListener("load", async () => {
  const found = {};
  try {
    await (async () => { %s })();
  } catch (error) {
    problems.push(String(error));
  }
  found.problems = problems;
  const result = document.createElement("pre");
  result.id = "result";
  result.textContent = JSON.stringify(found);
  document.body.append(result);
});
</script>"""


def in_browser(site: Path, page: str, script: str, tmp_path: Path) -> dict[str, Any]:
    """Open a copy of a page as a file, run a script in it, and return what it has put into `found`."""
    copy = tmp_path / "site"
    shutil.copytree(site, copy)
    text = (copy / page).read_text()
    text = text.replace("<head>", "<head>" + BEFORE).replace("</body>", AFTER % script + "</body>")
    (copy / page).write_text(text)
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom"]
    flags += [
        "--virtual-time-budget=20000",
        "--window-size=1000,900",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ]
    flags.append(f"--user-data-dir={tmp_path / 'profile'}")
    assert CHROMIUM is not None
    done = subprocess.run(
        [CHROMIUM, *flags, (copy / page).as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    assert "CONSOLE" not in done.stderr, done.stderr
    ((_, content),) = [e for e in Elements(done.stdout).of("pre") if e[0].get("id") == "result"]
    found: dict[str, Any] = json.loads(content)
    assert found["problems"] == []
    return found


@in_a_browser
def test_the_board_sorts_and_filters(site: Path, tmp_path: Path) -> None:
    script = """
      const rows = () => [...document.getElementById("board").tBodies[0].rows].filter((row) => !row.hidden);
      const column = (place) => rows().map((row) => row.cells[place].dataset.value ?? row.cells[place].textContent);
      const header = (name) => [...document.querySelectorAll("#board th button")].find((b) => b.textContent === name);
      const place = (name) => header(name).closest("th").cellIndex;
      const all = document.getElementById("board").tBodies[0].rows.length;
      const { task, track, context } = document.getElementById("filters").elements;
      found.first = [all, rows().length, document.getElementById("count").textContent];
      header("model").click();
      found.names = column(0);
      header("error").click();
      found.up = column(place("error"));
      header("error").click();
      found.down = column(place("error"));
      found.arrow = header("error").closest("th").getAttribute("aria-sort");
      change(context, "10");
      found.ten = column(place("context"));
      change(track, "ablations");
      found.ablations = [...new Set(column(0))];
      change(track, "");
      change(context, "");
      found.everything = rows().length;
    """
    found = in_browser(site, "index.html", script, tmp_path)
    assert found["first"] == [18, 5, "5 of 18 rows"]
    assert found["names"] == ["egno", "m3gn", "mango", "mgn", "stand_still"]
    errors = [float(value) for value in found["up"]]
    assert errors == sorted(errors)
    assert [float(value) for value in found["down"]] == errors[::-1]
    assert found["arrow"] == "descending"
    assert found["ten"] == ["10"] * 5
    assert found["ablations"] == ["mgn_mp"]
    assert found["everything"] == 18


@in_a_browser
def test_rollouts_move(site: Path, tmp_path: Path) -> None:
    script = """
      await wait(() => scene !== null);
      const picture = () => { draw(); return viewer.canvas.toDataURL(); };
      const text = () => document.getElementById("frame").textContent;
      const pictures = [picture()];
      found.texts = [text()];
      const see = () => { pictures.push(picture()); found.texts.push(text()); };
      change(time, "0"); see();
      change(time, "30"); see();
      change(model, "mgn"); see();
      change(context, "10"); see();
      viewer.canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "ArrowLeft" })); see();
      viewer.canvas.dispatchEvent(new WheelEvent("wheel", { deltaY: 100, cancelable: true })); see();
      wire.click(); see();
      play.click();
      await wait(() => text() !== found.texts.at(-1));
      found.playing = [play.textContent, text()];
      play.click();
      found.paused = play.textContent;
      found.different = new Set(pictures).size === pictures.length;
      found.facts = document.getElementById("facts").textContent;
      found.shown = [model.value, context.value, trajectory.value];
    """
    found = in_browser(site, "rollouts.html", script, tmp_path)
    assert found["different"]
    assert found["texts"][:3] == [
        "frame 50 of 50, predicted",
        "frame 0 of 50, context",
        "frame 30 of 50, predicted",
    ]
    assert found["playing"][0] == "Pause"
    assert re.fullmatch(r"frame 3[1-9] of 50, predicted", found["playing"][1])
    assert found["paused"] == "Play"
    model, context, name = found["shown"]
    assert (model, context) == ("mgn", "10")
    (shown,) = [
        one for one in script_of(site, name)["predictions"] if (one["model"], one["context"]) == (model, 10)
    ]
    numbers = [float(value) for value in re.findall(r"([\d.]+) \S 10⁻⁶", found["facts"])]
    assert numbers == pytest.approx([1e6 * shown["mse"], 1e6 * shown["mean_mse"]], rel=5e-3)
