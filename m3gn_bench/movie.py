"""Images one after the other, as one file: .gif with Pillow, .mp4 with PyAV (extra `movie`)."""

import io
from collections.abc import Iterator, Sequence
from itertools import chain

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


def require_mp4() -> None:
    """Raise ConfigError unless there is a library that writes .mp4."""
    try:
        import av  # noqa: F401
    except ImportError as error:
        raise ConfigError(f"an .mp4 needs PyAV ({error}); pip install 'm3gn-bench[movie]'") from error


def mp4(images: Iterator[Pixels], fps: int) -> bytes:
    """An MP4 in H.264, in the form that every browser plays.

    Args:
        images: at least one, each of shape [rows, columns, 3].
        fps: frames per second.

    Raises:
        ConfigError: PyAV is missing.
    """
    require_mp4()
    import av

    first = next(images)
    rows, columns, _ = first.shape
    # This form halves the resolution of colours, so it takes even sizes only.
    margins = ((0, rows % 2), (0, columns % 2), (0, 0))
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=fps, options={"crf": QUALITY})
        stream.height, stream.width = rows + rows % 2, columns + columns % 2
        stream.pix_fmt = "yuv420p"
        for image in chain([first], images):
            frame = av.VideoFrame.from_ndarray(np.pad(image, margins, mode="edge"), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return buffer.getvalue()


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
