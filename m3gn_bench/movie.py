"""Images one after the other, as one file: .gif with Pillow, .mp4 with the program ffmpeg."""

import io
import shutil
from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path
from subprocess import PIPE, Popen
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from m3gn_bench.errors import ConfigError

Pixels = NDArray[np.uint8]

QUALITY = "18"  # x264's constant rate factor: thin lines and small print stay sharp


def gif(images: Iterator[Pixels], samples: Sequence[Pixels], fps: int) -> bytes:
    """A GIF that repeats for ever.

    Args:
        images: at least one, each of shape [rows, columns, 3].
        samples: some of them, which the palette is made from.
        fps: frames per second.
    """
    # One palette for all: with one for each image the colours would flicker.
    palette = _palette(np.concatenate([sample.reshape(-1, 3) for sample in samples]))
    drawn = (Image.fromarray(image).quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    buffer = io.BytesIO()
    next(drawn).save(buffer, "GIF", save_all=True, append_images=drawn, duration=round(1000 / fps), loop=0)
    return buffer.getvalue()


def require_mp4() -> str:
    """The program that writes .mp4. Raises ConfigError if it is not installed."""
    program = shutil.which("ffmpeg")
    if program is None:
        raise ConfigError("an .mp4 needs the program ffmpeg (e.g. apt install ffmpeg, brew install ffmpeg)")
    return program


def mp4(images: Iterator[Pixels], fps: int) -> bytes:
    """An MP4 in H.264, in the form that every browser plays.

    A program of its own: encoders of this kind come under licences that a dependency of ours may not have.

    Args:
        images: at least one, each of shape [rows, columns, 3].
        fps: frames per second.

    Raises:
        ConfigError: ffmpeg is missing, or refuses.
    """
    program = require_mp4()
    first = next(images)
    rows, columns, _ = first.shape
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{columns}x{rows}", "-r", str(fps), "-i", "-"]
    # This form halves the resolution of colours, so it takes even sizes only.
    form = [
        "-vf",
        "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white",
        "-pix_fmt",
        "yuv420p",
        "-movflags",
        "+faststart",
    ]
    with TemporaryDirectory() as folder:
        path, messages = Path(folder) / "movie.mp4", Path(folder) / "messages"
        command = [program, "-loglevel", "error", *raw, *form, "-crf", QUALITY, str(path)]
        with messages.open("wb") as errors, Popen(command, stdin=PIPE, stderr=errors) as process:
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # it has ended, and says why
                for image in chain([first], images):
                    process.stdin.write(image.tobytes())
                process.stdin.close()
        if process.returncode:
            raise ConfigError(f"ffmpeg could not write the .mp4: {messages.read_text(errors='replace')}")
        return path.read_bytes()


def _palette(pixels: Pixels) -> Image.Image:
    """White and 255 colours that stand for those of the pixels, shape [pixels, 3], the rare like the frequent.

    If frequency counted, the background would take most of them and a thin red arrow would turn grey.
    """
    red, green, blue = pixels.astype(np.int32).T
    different = np.unique(red << 16 | green << 8 | blue)  # far faster than unique rows
    channels = np.stack([different >> 16, different >> 8 & 255, different & 255], -1).astype(np.uint8)
    # Pillow looks colours up in steps of four levels, so an entry next to white would take white's place.
    channels = channels[channels.min(1) < 248]
    colours = Image.fromarray(channels[None]).quantize(255, kmeans=1).getpalette() or []
    palette = Image.new("P", (1, 1))
    palette.putpalette([255, 255, 255, *colours])
    return palette
