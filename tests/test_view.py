"""Pictures of trajectories: the right things at the right places, and clear errors."""

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import TetraWriter

pytest.importorskip("matplotlib")
from PIL import Image

from m3gn_bench import movie, picture, picture_geometry, picture_page
from m3gn_bench.baselines.trivial import StandStill
from m3gn_bench.checkpoint import load_checkpoint
from m3gn_bench.cli import run
from m3gn_bench.data import Context, case_from
from m3gn_bench.datasets.file import open_file, read_metadata, read_trajectory
from m3gn_bench.datasets.schema import Metadata
from m3gn_bench.datasets.trajectory import FIXED, FREE, VTK_TETRA, VTK_TRIANGLE, Mesh, Trajectory
from m3gn_bench.errors import ConfigError
from m3gn_bench.generators.scene import scene_names
from m3gn_bench.leaderboard import record
from m3gn_bench.leaderboard.record import checkpoint_folder
from m3gn_bench.picture import Camera, Picture
from m3gn_bench.predictions import predict
from m3gn_bench.tasks import get_task
from m3gn_bench.view import LOOKS, Look, select_frames

FRAMES = 4
DPI = picture.STILL_DPI
TITLE = picture_page.ABOVE + picture_page.LINE
SQUARE = np.array([[0, 1, 3], [0, 3, 2]], np.int32)  # of four nodes, row by row
OCTAHEDRON = np.array(
    [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], np.int32
)


def block() -> Trajectory:
    """A square whose top is pressed down by a circle of radius 20 that comes from above."""
    rest = np.array([[-50, -100], [50, -100], [-50, 0], [50, 0]], np.float32)
    positions = np.repeat(rest[None], FRAMES, axis=0)
    positions[:, 2:, 1] -= 10 * np.arange(FRAMES)[:, None]
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    circle = 20 * np.column_stack([np.cos(angles), np.sin(angles)])
    centres = [[10, 30 - 10 * frame] for frame in range(FRAMES)]
    nodes = np.arange(40)
    return Trajectory(
        positions=positions,
        mesh=Mesh(rest, SQUARE, VTK_TRIANGLE, np.array([FIXED, FIXED, FREE, FREE], np.uint8)),
        material={"poisson_ratio": -0.9},
        collider_positions=np.array([circle + centre for centre in centres], np.float32),
        collider_edges=np.column_stack([nodes, np.roll(nodes, -1)]).astype(np.int32),
    )


def ball() -> Trajectory:
    """An octahedron that falls onto the floor, where it is flattened."""
    rest = 0.25 * np.concatenate([sign * np.eye(3)[[axis]] for axis in range(3) for sign in (1, -1)])
    heights = [1.0, 0.75, 0.5, 0.2]
    positions = np.array([rest * (1, 1, min(1, 4 * height)) + (0, 0, height) for height in heights])
    return Trajectory(
        positions=positions.astype(np.float32),
        mesh=Mesh(rest.astype(np.float32), OCTAHEDRON, VTK_TRIANGLE, np.zeros(6, np.uint8)),
        material={"youngs_modulus": 3.2e5, "poisson_ratio": 0.49},
        tags={"object": "octahedron"},
    )


def metadata_of(tetra_metadata: Metadata, scene: str, dimension: int) -> Metadata:
    """Metadata under a scene's name, whose look is then used."""
    units = {"youngs_modulus": "Pa", "poisson_ratio": "1"}
    changes = {"scene": scene, "material_units": units, "load_units": {}, "scale_centre": (0.0,) * dimension}
    return tetra_metadata.model_copy(update=changes)


@pytest.fixture(scope="module")
def files(
    tmp_path_factory: pytest.TempPathFactory, write_tetra: TetraWriter, tetra_metadata: Metadata
) -> dict[str, Path]:
    """A dataset file of each kind: in the plane, in space with a floor, tetrahedra, not a number."""
    folder = tmp_path_factory.mktemp("view")
    few = {"test_00000", "test_00001"}
    broken = block()
    broken.positions[1, 2, 0] = np.nan
    flat, solid = (
        metadata_of(tetra_metadata, *scene) for scene in (("deformable_block", 2), ("mixed_objects", 3))
    )
    return {
        "block": write_tetra(folder / "block.h5", change=lambda *_: block(), metadata=flat, only=few),
        "ball": write_tetra(folder / "ball.h5", change=lambda *_: ball(), metadata=solid, only=few),
        "tetra": write_tetra(folder / "tetra.h5", only=few),
        "nan": write_tetra(folder / "nan.h5", change=lambda *_: broken, metadata=flat, only=few),
    }


def view(*arguments: object) -> int:
    """Exit code of the command."""
    with pytest.raises(SystemExit) as stop:
        run(["view", *(str(argument) for argument in arguments)])
    return int(stop.value.code or 0)


def pixels(image: Image.Image) -> np.ndarray:
    """Shape [rows, columns, 3], integers."""
    return np.asarray(image.convert("RGB")).astype(int)


def near(image: np.ndarray, colour: str, tolerance: int = 2) -> np.ndarray:
    """Where the image has a colour, shape [rows, columns]."""
    wanted = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return (np.abs(image - wanted) <= tolerance).all(-1)


def draw(trajectory: Trajectory, metadata: Metadata, look: Look, frames: list[int]) -> np.ndarray:
    """A still."""
    content = Picture(trajectory, metadata, look, look.colour, "title").still(frames)
    return pixels(Image.open(io.BytesIO(content)))


# --- files ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["block", "ball", "tetra"])
def test_still(files: dict[str, Path], tmp_path: Path, kind: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "new folder" / "x.png"
    assert view(files[kind], "--index", 1, "-o", out, "--frames", "0,3", "--json") == 0
    record = json.loads(capsys.readouterr().out)
    assert record == {
        "file": str(out),
        "trajectory": "test_00001",
        "frames": [0, 3],
        "panels": ["truth"],
        "context": None,
    }
    assert [path.name for path in out.parent.iterdir()] == ["x.png"]
    image = pixels(Image.open(out))
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50
    assert near(image, "#ffffff").mean() < 0.97


@pytest.mark.parametrize(("kind", "frames"), [("block", None), ("ball", "3")])
def test_animation(files: dict[str, Path], tmp_path: Path, kind: str, frames: str | None) -> None:
    out = tmp_path / "x.gif"
    wanted = [] if frames is None else ["--frames", frames]
    assert view(files[kind], "--split", "test", "-o", out, "--fps", 10, *wanted) == 0
    with Image.open(out) as movie:
        assert (movie.n_frames, movie.info["duration"], movie.info["loop"]) == (int(frames or FRAMES), 100, 0)
        first = pixels(movie)
        movie.seek(movie.n_frames - 1)
        last = pixels(movie)
    assert (first[0, 0] == 255).all()  # the palette has kept white
    assert len(np.unique(first.reshape(-1, 3), axis=0)) > 30
    changed = (first != last).any(-1)
    assert 0.01 < changed.mean() < 0.7
    assert not changed[: len(changed) // 20].any()  # the heading stays


def test_without_a_display(files: dict[str, Path], tmp_path: Path) -> None:
    """In a process of its own, as if on a server, with a backend that cannot work there, and without torch."""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("DISPLAY")}
    command = [
        sys.executable,
        "-c",
        "import sys; sys.modules['torch'] = None; from m3gn_bench.cli import run; run()",
    ]
    arguments = ["view", str(files["tetra"]), "-o", "x.png", "--frames", "1"]
    subprocess.run(
        [*command, *arguments], cwd=tmp_path, env=environment | {"MPLBACKEND": "tkagg"}, check=True
    )
    image = pixels(Image.open(tmp_path / "x.png"))
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 50


# --- what is in the picture -------------------------------------------------------------------------------


def test_circle_is_round_and_where_it_belongs(tetra_metadata: Metadata) -> None:
    metadata, look = metadata_of(tetra_metadata, "deformable_block", 2), LOOKS["deformable_block"]
    image = draw(block(), metadata, look, [2])
    legend = int(len(image) - DPI * picture_page.FOOT)
    rows, columns = np.nonzero(near(image[:legend], picture.COLLIDER))
    unit = DPI * picture.STILL_PANEL / (150 * 1.1)  # pixels; the motion spans 150, from y = -100 to 50
    assert np.ptp(rows) == pytest.approx(40 * unit, abs=5)
    assert np.ptp(columns) == pytest.approx(40 * unit, abs=5)
    # Frame 2 has its centre at y = 10, so 40 below the top of the motion.
    top = DPI * (picture_page.HEAD + TITLE) + 0.05 * 150 * unit
    assert rows.mean() == pytest.approx(top + 40 * unit, abs=3)


def test_ball_falls_at_one_scale(tetra_metadata: Metadata) -> None:
    metadata, look = metadata_of(tetra_metadata, "mixed_objects", 3), LOOKS["mixed_objects"]
    heights, sizes = [], []
    for frame in range(3):
        image = draw(ball(), metadata, look, [frame])
        panel = image[int(DPI * (picture_page.HEAD + TITLE)) : int(len(image) - DPI * picture_page.FOOT)]
        assert near(panel, picture.FLOOR).mean() > 0.005
        assert near(panel, picture.SHADOW).mean() > 0.005
        grey = (np.ptp(panel, axis=-1) < 12) & (panel.max(-1) > 100) & (panel.max(-1) < 215)
        rows = np.nonzero(grey & ~near(panel, picture.SHADOW) & ~near(panel, picture.FLOOR_LINE))[0]
        heights.append(float(np.median(rows)))
        sizes.append(len(rows))
    assert sizes[1:] == pytest.approx(sizes[:1] * 2, rel=0.05)
    fall = DPI * picture.STILL_PANEL / 1.5 * 0.25  # 0.25 from frame to frame, in a panel about 1.5 high
    assert np.diff(heights) == pytest.approx([fall, fall], rel=0.15)
    landed = draw(ball(), metadata, look, [3])[:, : int(DPI * picture_page.LEAST_WIDTH / 2)]
    blue = landed[..., 2] > landed[..., 0] + 50  # flattened by the factor 0.8, and in front of the floor
    assert blue.sum() == pytest.approx(0.8 * sizes[0], rel=0.1)


def test_near_triangles_hide_far_ones(tetra_metadata: Metadata) -> None:
    look = Look(azimuth=30.0, elevation=25.0)
    right, up, towards = Camera(3, look.azimuth, look.elevation).axes
    triangle = np.array([-right - up, right - up, up])
    metadata = metadata_of(tetra_metadata, "unknown", 3)

    def middle(order: list[int]) -> np.ndarray:
        rest = np.concatenate([triangle - towards, triangle + towards]).astype(np.float32)
        moved = rest.copy()
        moved[3:] += (0.2 * towards).astype(np.float32)  # the nearer one moves, and gets the last colour
        cells = np.array([[0, 1, 2], [3, 4, 5]], np.int32)[order]
        mesh = Mesh(rest, cells, VTK_TRIANGLE, np.zeros(6, np.uint8))
        image = draw(Trajectory(np.array([rest, moved]), mesh, {}), metadata, look, [1])
        across = (picture_page.LEAST_WIDTH - picture_page.BAR) / 2
        return image[int(DPI * (picture_page.HEAD + TITLE + picture.STILL_PANEL / 2)), int(DPI * across)]

    assert (middle([0, 1]) == middle([1, 0])).all()
    red, _, blue = middle([0, 1])
    assert blue > red + 30  # dark blue, not the pale yellow of the triangle behind


def test_a_triangle_that_faces_the_light(tetra_metadata: Metadata) -> None:
    """Rounding must not make it brighter than its colour, which matplotlib would refuse."""
    look = Look()
    towards = picture.LIGHT @ Camera(3, look.azimuth, look.elevation).axes
    across = np.cross(towards, [0, 0, 1])
    rest = np.array([across, -across, np.cross(towards, across)], np.float32)
    mesh = Mesh(rest, np.array([[0, 1, 2]], np.int32), VTK_TRIANGLE, np.zeros(3, np.uint8))
    lit = Trajectory(np.repeat(rest[None], 2, axis=0), mesh, {})
    assert near(draw(lit, metadata_of(tetra_metadata, "unknown", 3), look, [0]), "#ffffd9").mean() > 0.01


def test_heading_names_object_and_material(tetra_metadata: Metadata) -> None:
    made = Picture(ball(), metadata_of(tetra_metadata, "mixed_objects", 3), Look(), "height", "a title")
    nu = picture.SYMBOLS["poisson_ratio"]
    assert made.heading == ("a title", f"object octahedron, E = 3.2e+05 Pa, {nu} = 0.49")


def test_colours_have_the_right_numbers(tetra_metadata: Metadata) -> None:
    def values(colour: str, trajectory: Trajectory, scene: str) -> tuple[np.ndarray, float, float]:
        metadata = metadata_of(tetra_metadata, scene, trajectory.positions.shape[-1])
        made = Picture(trajectory, metadata, Look(), colour, "").colouring  # type: ignore[arg-type]
        return made.values[0, -1], made.norm.vmin, made.norm.vmax

    shown, low, high = values("displacement", block(), "deformable_block")
    assert shown == pytest.approx([10, 20])  # one and two of three corners have moved by 30
    assert (low, high) == (0, pytest.approx(20))
    shown, low, high = values("height", block(), "deformable_block")
    assert shown == pytest.approx([-10, -20])
    assert (low, high) == (pytest.approx(-20), pytest.approx(20))
    shown, low, high = values("area", block(), "deformable_block")
    assert shown == pytest.approx([0.7, 0.7])
    assert (low, high) == (pytest.approx(0.7), pytest.approx(1.3))
    # An octahedron's face, flattened by the factor 0.8: sqrt(1 + 2 * 0.8^2) / sqrt(3).
    assert values("area", ball(), "mixed_objects")[0] == pytest.approx(np.full(8, np.sqrt(2.28 / 3)))


# --- models beside the truth ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, smoke_file: Path) -> Path:
    """A leaderboard's folder with tiny models of Sheet Deformation, where those that ship would lie."""
    home = tmp_path_factory.mktemp("board")
    for model in ("m3gn", "mgn", "stand_still"):
        folder = checkpoint_folder("sheet_deformation", model, "compact", home=home)
        task = ["--task", "sheet_deformation", "--model", model, "--preset", "smoke", "--steps", "2"]
        with pytest.raises(SystemExit) as stop:
            run(["train", *task, "--data", str(smoke_file.parent), "--tier", "smoke", "--out", str(folder)])
        assert not stop.value.code
    return home


@pytest.fixture
def shipped(trained: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Let the command find these models instead of the project's."""
    monkeypatch.setattr(record, "checkpoint_folder", lambda *run: checkpoint_folder(*run, home=trained))
    return trained


def predicted(
    smoke_file: Path, home: Path, *models: str, context: int = 5
) -> tuple[Trajectory, Metadata, dict[str, np.ndarray]]:
    """The first test trajectory, and what models make of it."""
    with open_file(smoke_file) as file:
        metadata, trajectory = read_metadata(file), read_trajectory(file, "test_00000")
    task = get_task("sheet_deformation")
    folders = {model: checkpoint_folder(task.name, model, "compact", home=home) for model in models}
    return trajectory, metadata, predict(folders, task, context, trajectory, "test_00000", metadata)


def test_still_of_models(
    shipped: Path, smoke_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "x.png"
    models = ["--model", "m3gn", "--model", "mgn"]
    assert view(smoke_file, *models, "-o", out, "--frames", "0,4,50", "--context", "5", "--json") == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["panels"], shown["context"]) == (["truth", "m3gn", "mgn"], 5)
    image = pixels(Image.open(out))

    title, width, gap = picture_page.ABOVE + 2 * picture_page.LINE, picture.STILL_PANEL, picture_page.GAP
    row = (len(image) / DPI - picture_page.HEAD - picture_page.FOOT) / 3  # a title and a panel

    def panel(frame: int, motion: int) -> np.ndarray:
        left, top = gap + motion * (width + gap), picture_page.HEAD + frame * row + title
        corner = image[round(DPI * top) :, round(DPI * left) :]
        return corner[: int(DPI * (row - title)) - 1, : int(DPI * width)]

    for motion in (1, 2):
        for frame in (0, 1):  # context, up to the anchor
            assert (panel(frame, motion) == panel(frame, 0)).all()
        changed = (panel(2, motion) != panel(2, 0)).any(-1)
        assert 0.1 < changed.mean() < 0.9
    assert (panel(2, 1) != panel(2, 2)).any()


needs_ffmpeg = pytest.mark.skipif(
    shutil.which("ffmpeg") is None, reason="the program ffmpeg is not installed"
)


def film(path: Path, width: int, height: int) -> np.ndarray:
    """All images of a film, as ffmpeg decodes them."""
    command = ["ffmpeg", "-loglevel", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3).astype(int)


@needs_ffmpeg
def test_animations_of_models(shipped: Path, smoke_file: Path, tmp_path: Path) -> None:
    """In both forms the same panels, one beside the other, and the same frames at the same pace."""
    for name in ("x.gif", "x.mp4"):
        models = ["--model", "m3gn", "--model", "mgn"]
        assert view(smoke_file, *models, "-o", tmp_path / name, "--frames", "0,5,50", "--fps", 10) == 0
    with Image.open(tmp_path / "x.gif") as movie:
        size, frames = movie.size, []
        for number in range(movie.n_frames):
            movie.seek(number)
            frames.append(pixels(movie))
    width, height = size
    shown = film(tmp_path / "x.mp4", width + width % 2, height + height % 2)
    probe = [
        "ffprobe",
        "-v",
        "error",
        "-show_entries",
        "stream=codec_name,pix_fmt,r_frame_rate",
        "-of",
        "csv",
    ]
    found = subprocess.run(
        [*probe, str(tmp_path / "x.mp4")], capture_output=True, check=True, text=True
    ).stdout
    assert found.strip() == "stream,h264,yuv420p,10/1"
    assert len(frames) == len(shown) == 3
    assert width > 3 * picture.MOVIE_DPI * picture.COMPARED_PANEL
    for a, b in zip(frames, shown, strict=True):
        assert np.abs(a - b[:height, :width]).mean() < 4
    thirds = np.array_split((frames[0] != frames[-1]).any(-1)[:, : 3 * int(width / 3.3)], 3, axis=1)
    assert min(third.mean() for third in thirds) > 0.05  # all panels move


@needs_ffmpeg
def test_sizes_that_video_does_not_take(tmp_path: Path) -> None:
    """Odd numbers of rows and columns are filled up."""
    image = np.full((33, 47, 3), 200, np.uint8)
    (tmp_path / "x.mp4").write_bytes(movie.mp4(iter([image, image]), fps=20))
    shown = film(tmp_path / "x.mp4", 48, 34)
    assert len(shown) == 2
    assert np.abs(shown[:, :32, :46] - 200).max() <= 5


@needs_ffmpeg
def test_what_ffmpeg_refuses() -> None:
    with pytest.raises(ConfigError, match="ffmpeg could not write"):
        movie.mp4(iter([np.zeros((4, 4, 3), np.uint8)]), fps=-3)


def test_predictions_in_the_units_of_the_file(trained: Path, smoke_file: Path) -> None:
    trajectory, metadata, found = predicted(smoke_file, trained, "mgn", "stand_still")
    case = case_from(get_task("sheet_deformation"), metadata, trajectory, "test_00000")
    for positions in found.values():
        assert positions.shape == trajectory.positions.shape
        assert (positions[:5] == trajectory.positions[:5]).all()
    assert found["stand_still"][5:] == pytest.approx(
        np.broadcast_to(trajectory.positions[4], found["stand_still"][5:].shape), abs=1e-4
    )
    model, _ = load_checkpoint(checkpoint_folder("sheet_deformation", "mgn", "compact", home=trained))
    with torch.inference_mode():
        scaled = model.predict(case.context(5)).numpy()
    assert found["mgn"][5:] == pytest.approx(scaled * 70 + np.array([70, 70, 0]), abs=1e-4)


def test_colours_are_distances_from_the_truth(trained: Path, smoke_file: Path) -> None:
    trajectory, metadata, found = predicted(smoke_file, trained, "stand_still", context=3)
    made = Picture(trajectory, metadata, Look(), "distance", "", predictions=found, context=3)
    colours = made.colouring
    moved = np.linalg.norm(trajectory.positions - trajectory.positions[2], axis=-1)
    expected = moved[:, trajectory.mesh.cells].mean(-1)
    assert (colours.values[0] == 0).all()
    assert (colours.values[1, :3] == 0).all()
    assert colours.values[1, 3:] == pytest.approx(expected[3:], abs=1e-4)
    assert (colours.norm.vmin, colours.norm.vmax) == (0, pytest.approx(expected.max(), abs=1e-4))
    assert colours.label == "distance from the truth [mm]"
    assert made.title(0, 2) == ["truth", "frame 2, t = 0.04"]
    assert made.title(1, 2) == ["stand_still", "context"]
    name, distance = made.title(1, 50)
    assert (name, distance) == ("stand_still", f"mean distance {moved[50].mean():#.3g} mm")


def test_a_prediction_that_leaves_the_scene(tetra_metadata: Metadata) -> None:
    """The truth keeps its size and colours do not all become the same."""
    truth, metadata = block(), metadata_of(tetra_metadata, "deformable_block", 2)
    far = truth.positions + np.array([1e6, 0]) * np.arange(FRAMES)[:, None, None]
    near = truth.positions + np.array([0, 5])
    alone = Picture(truth, metadata, Look(), "displacement", "")
    made = Picture(truth, metadata, Look(), "distance", "", predictions={"far": far, "near": near}, context=1)
    assert (made.upper - made.lower)[0] < 2 * (alone.upper - alone.lower)[0]
    assert made.colouring.norm.vmax == 100
    assert made.colouring.beyond == (False, True)
    assert len(pixels(Image.open(io.BytesIO(made.still([0, 3])))))


def test_the_truth_is_drawn_over_predictions(tetra_metadata: Metadata) -> None:
    """Shifted aside by 40: the true outline stays where the truth is, and only after the context."""
    truth, metadata = block(), metadata_of(tetra_metadata, "deformable_block", 2)
    moved = truth.positions + np.array([40.0, 0.0])
    made = Picture(truth, metadata, Look(), "distance", "", predictions={"moved": moved}, context=2)
    image = pixels(Image.open(io.BytesIO(made.still([1, 3]))))
    lines = near(image[: int(len(image) - DPI * picture_page.FOOT)], picture.TRUTH, tolerance=25)
    rows, columns = np.nonzero(lines)
    unit = DPI * picture.STILL_PANEL / (made.upper - made.lower).max()
    assert np.ptp(columns) == pytest.approx(100 * unit, abs=4)
    assert rows.min() > len(image) / 2


# --- geometry ---------------------------------------------------------------------------------------------


def test_surface_of_tetrahedra() -> None:
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float32)
    cells = np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32)
    faces = picture_geometry.surface(Mesh(rest, cells, VTK_TETRA, np.zeros(5, np.uint8)))
    assert len(faces) == 6
    assert {1, 2, 3} not in [set(face) for face in faces.tolist()]
    assert len(picture_geometry.outline(faces)) == 0
    a, b, c = rest[faces].swapaxes(0, 1)
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(1 / 6 + 1 / 3)  # outwards: the volume is positive


def test_outline_and_rings() -> None:
    assert {frozenset(edge) for edge in picture_geometry.outline(SQUARE).tolist()} == {
        frozenset(edge) for edge in ((0, 1), (1, 3), (3, 2), (2, 0))
    }
    two = np.array([[0, 1], [1, 2], [2, 0], [3, 5], [5, 4], [4, 6], [6, 3], [0, 1]])
    assert [sorted(ring) for ring in picture_geometry.rings(two)] == [[0, 1, 2], [3, 4, 5, 6]]
    (_, square) = picture_geometry.rings(two)
    assert square in ([3, 5, 4, 6], [3, 6, 4, 5])
    assert picture_geometry.rings(np.array([[0, 1], [1, 2]])) == []


def test_silhouette_and_wireframe() -> None:
    """Seen from above, an octahedron's border is the square around its middle."""
    facing = (OCTAHEDRON == 4).any(1)
    found = {frozenset(edge) for edge in picture_geometry.silhouette(OCTAHEDRON, facing).tolist()}
    assert found == {frozenset(edge) for edge in ((0, 2), (2, 1), (1, 3), (3, 0))}
    assert len(picture_geometry.wireframe(OCTAHEDRON)) == 12
    assert len(picture_geometry.wireframe(SQUARE)) == 5


def test_camera_keeps_lengths() -> None:
    camera = Camera(3, azimuth=-37.0, elevation=21.0)
    assert camera.axes @ camera.axes.T == pytest.approx(np.eye(3))
    assert np.linalg.det(camera.axes) == pytest.approx(1)
    assert camera(np.array([0, 0, 1.0])) == pytest.approx([0, np.cos(np.deg2rad(21))])  # z is up
    assert (Camera(2, -37.0, 21.0)(np.array([[1.0, 2.0]])) == [[1, 2]]).all()


@pytest.mark.parametrize(("length", "expected"), [(1.0, 1.0), (0.7, 0.5), (49.9, 20.0), (3e-4, 2e-4)])
def test_round_length(length: float, expected: float) -> None:
    assert picture_geometry.round_length(length) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, [0, 10, 20, 30, 40, 50]),
        ("3", [0, 25, 50]),
        ("1", [0]),
        ("51", list(range(51))),
        ("5,7", [5, 7]),
        ("7,", [7]),
        ("50, 0", [50, 0]),
    ],
)
def test_select_frames(text: str | None, expected: list[int]) -> None:
    assert select_frames(text, 51, 6) == expected


def test_fewer_frames_than_usual() -> None:
    assert select_frames(None, 4, 6) == [0, 1, 2, 3]


@pytest.mark.parametrize("text", ["", ",", "a", "0", "52", "-1", "51,", "0,-1", "1.5", "1,,2"])
def test_frames_that_make_no_sense(text: str) -> None:
    with pytest.raises(ConfigError, match=r"frame"):
        select_frames(text, 51, 6)


def test_every_scene_has_a_look() -> None:
    from m3gn_bench.generators import deformable_block

    assert set(LOOKS) == set(scene_names())
    assert LOOKS["deformable_block"].floor == deformable_block.BASE


# --- errors -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        ("block", ["-o", "x.avi"], "x.avi must end in .png (a still), .gif (an animation) or .mp4 (an animation)"),
        ("block", ["-o", "x"], "must end in .png"),
        ("block", ["-o", "x.png", "--index", "2"], "index 2 is out of range: {} has 2 test trajectories, 0 to 1"),
        ("block", ["-o", "x.png", "--index", "-1"], "index -1 is out of range"),
        ("block", ["-o", "x.png", "--split", "dev"], "unknown split 'dev'; known: test, train, validation"),
        ("block", ["-o", "x.png", "--split", "train"], "{} has no train trajectories; it has test"),
        ("block", ["-o", "x.gif", "--frames", "0,4"], "frame 4 is out of range: the trajectory has frames 0 to 3"),
        ("block", ["-o", "x.png", "--frames", "5"], "5 frames are out of range: the trajectory has 4"),
        ("block", ["-o", "x.png", "--frames", "all"], "'all' is neither a number of frames"),
        ("block", ["-o", "x.gif", "--fps", "0"], "0 frames per second are out of range: 1 to 50"),
        ("block", ["-o", "x.png", "--colour", "red"], "unknown colour 'red'; known: area, displacement, distance"),
        ("block", ["-o", "x.png", "--colour", "distance"], "name a model or a checkpoint"),
        ("block", ["-o", "x.png", "--context", "2"], "--task and --context are for models"),
        ("block", ["-o", "x.png", "--model", "m4gn"], "unknown model 'm4gn'; known: "),
        ("block", ["-o", "x.png", "--model", "mgn", "--task", "x"], "unknown task 'x'; known: deformable_block"),
        ("tetra", ["-o", "x.png", "--model", "mgn"], "unknown task 'tetra_task'; known: deformable_block"),
        ("block", ["-o", "x.png", "--checkpoint", "none"], "no checkpoint in none"),
        ("block", [], "Missing option '--output'"),
        ("nan", ["-o", "x.png"], "trajectory test_00000 cannot be drawn; 'm3gn-bench validate'"),
        ("absent", ["-o", "x.png"], "no dataset file at {}"),
    ],
)  # fmt: skip
def test_errors(
    files: dict[str, Path],
    kind: str,
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    file = files.get(kind, Path("absent.h5"))
    assert view(file, *arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.splitlines()[-1].lower().startswith("error: ")
    assert message.format(file) in shown.err.splitlines()[-1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--model", "mgn", "--model", "mango"], "no checkpoint of mango on sheet_deformation ships with the project"),
        (["--model", "mango"], "(there are m3gn, mgn, stand_still); train one and pass --checkpoint"),
        (["--model", "mgn", "--task", "sheet_deformation_ood"], "no checkpoint of mgn on sheet_deformation_ood ships"),
        (["--checkpoint", "{mgn}", "--task", "sheet_deformation_ood"], "was trained on sheet_deformation, not on"),
        (["--checkpoint", "{mgn}", "--task", "deformable_block"], "unknown task 'deformable_block'; known: sheet_"),
        (["--model", "mgn", "--context", "51"], "context size 51 is out of range"),
        (["--model", "mgn", "--context", "1"], "context size 1 is out of range"),
        (["--checkpoint", "{empty}"], "no checkpoint in"),
    ],
)  # fmt: skip
def test_errors_of_models(
    shipped: Path,
    smoke_file: Path,
    tmp_path: Path,
    arguments: list[str],
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folders = {
        "{mgn}": checkpoint_folder("sheet_deformation", "mgn", "compact", home=shipped),
        "{empty}": tmp_path,
    }
    given = [folders.get(argument, argument) for argument in arguments]
    assert view(smoke_file, "-o", tmp_path / "x.png", *given) == 2
    shown = capsys.readouterr()
    assert message in shown.err.splitlines()[-1]
    assert shown.out == ""
    assert list(tmp_path.iterdir()) == []


def test_runs_beside_models_that_ship(
    shipped: Path, smoke_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their names tell them apart, and a run's task need not be named."""
    run_folder = checkpoint_folder("sheet_deformation", "mgn", "compact", home=shipped)
    still = checkpoint_folder("sheet_deformation", "stand_still", "compact", home=shipped)
    arguments = ["--model", "mgn", "--checkpoint", run_folder, "--checkpoint", still, "--frames", 2]
    assert view(smoke_file, "-o", tmp_path / "x.png", *arguments, "--colour", "height", "--json") == 0
    assert json.loads(capsys.readouterr().out)["panels"] == [
        "truth",
        "mgn",
        f"mgn, {run_folder}",
        "stand_still",
    ]


@pytest.mark.parametrize(("split", "keys"), [("test", [0, 1]), ("validation", [2, 3])])
def test_a_task_s_trajectories_are_those_of_its_split(
    shipped: Path,
    smoke_file: Path,
    tmp_path: Path,
    split: str,
    keys: list[int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Those of Young's moduli 10 and 30 are in one task's test set alone, and counted there."""
    still, out = tmp_path / "still", tmp_path / "x.png"
    shutil.copytree(checkpoint_folder("sheet_deformation", "stand_still", "compact", home=shipped), still)
    described = json.loads((still / "checkpoint.json").read_text())
    (still / "checkpoint.json").write_text(json.dumps({**described, "task": "sheet_deformation_ood"}))
    arguments = ["--checkpoint", still, "--split", split, "--frames", 1, "-o", out]
    for index, number in enumerate(keys):
        assert view(smoke_file, *arguments, "--index", index, "--json") == 0
        assert json.loads(capsys.readouterr().out)["trajectory"] == f"{split}_{number:05d}"
    assert view(smoke_file, *arguments, "--index", 2) == 2
    assert f"has 2 {split} trajectories of task sheet_deformation_ood, 0 to 1" in capsys.readouterr().err


def test_a_model_that_diverges(
    shipped: Path,
    smoke_file: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def diverge(self: StandStill, context: Context) -> torch.Tensor:
        stays = context.positions[-1:].repeat(context.horizon, 1, 1)
        stays[7:] = torch.inf
        return stays

    monkeypatch.setattr(StandStill, "predict", diverge)
    assert view(smoke_file, "-o", tmp_path / "x.png", "--model", "stand_still", "--context", "5") == 2
    assert "stand_still diverges: its prediction is not finite from frame 12 on" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_mp4_without_its_program(
    files: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert view(files["block"], "-o", tmp_path / "x.mp4") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: an .mp4 needs the program ffmpeg")
    assert list(tmp_path.iterdir()) == []
    assert view(files["block"], "-o", tmp_path / "x.gif", "--frames", 1) == 0  # does not need it


def test_missing_library(
    files: dict[str, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for module in ("m3gn_bench.picture", "m3gn_bench.picture_colours"):
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert view(files["block"], "-o", tmp_path / "x.png") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: pictures need matplotlib")
    assert "pip install 'm3gn-bench[plot]'" in line


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError(28, "No space left on device")])
def test_interrupted_drawing_leaves_the_old_picture(
    files: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def stop(path: Path, content: bytes) -> int:
        path.open("wb").write(content[:10])
        raise error

    out = tmp_path / "x.png"
    out.write_text("old")
    monkeypatch.setattr(Path, "write_bytes", stop)
    assert view(files["block"], "-o", out, "--frames", 1) == (130 if error is KeyboardInterrupt else 2)
    assert [path.name for path in tmp_path.iterdir()] == ["x.png"]
    assert out.read_text() == "old"
