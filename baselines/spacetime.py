"""What the neural operators share: features over items (nodes or edges) and times, shape [items, times, width].

Times lie next to each other for every item, so gathering a node for an edge copies one long row, and a
convolution over time sees the layout that it is fastest in. On a CPU edges are handled some at a time, which
stay in the cache from one operation to the next.
"""

import torch
from torch import Tensor, nn

from m3gn_bench.graph import Graph

TIME_FEATURES = 32  # (paper's parameter counts)
CACHED = 2**20  # numbers that a CPU handles at a time


def edges_at_a_time(graph: Graph, times: int, width: int) -> int:
    """How many edges with features [times, width] to handle together; other devices take all of them."""
    if graph.senders.device.type != "cpu":
        return max(1, len(graph.senders))
    return max(1, CACHED // (times * width))


def temporal_encoding(numbers: Tensor, size: int) -> Tensor:
    """Sines and cosines of numbers at wavelengths from 2 pi to almost 20000 pi, shape [numbers, size].

    Vaswani et al. 2017, section 3.5.
    """
    frequencies = 10_000.0 ** -(torch.arange(0, size, 2, device=numbers.device) / size)
    angles = numbers[:, None] * frequencies
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def time_embedding(frames: Tensor, anchor: int) -> Tensor:
    """Encodes each frame's number and its distance from the anchor, shape [times, 32].

    The published counts fix the length only. One half each for both numbers, because loads follow the first and
    what is predicted vanishes where the second is zero.

    Args:
        frames: numbers of frames, shape [times], int.
        anchor: number of the anchor's frame.
    """
    half = TIME_FEATURES // 2
    return torch.cat([temporal_encoding(frames, half), temporal_encoding(frames - anchor, half)], dim=-1)


class SpaceTimeLinear(nn.Module):
    """A linear layer on the concatenation of features per item, per item and time, and per time.

    The three products are taken before they are spread over items and times, so nothing is concatenated.

    Args:
        static, moving, timed: lengths of the three features.
        width: length of the output.
    """

    def __init__(self, static: int, moving: int, timed: int, width: int) -> None:
        super().__init__()
        self.static = nn.Linear(static, width)
        self.moving = nn.Linear(moving, width, bias=False)
        self.timed = nn.Linear(timed, width, bias=False)

    def forward(self, static: Tensor, moving: Tensor, timed: Tensor) -> Tensor:
        """Shape [items, times, width] from [items, static], [items, times, moving] and [times, timed]."""
        out = self.moving(moving)
        out += self.static(static)[:, None]
        out += self.timed(timed)
        return out
