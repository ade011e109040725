"""How torch uses the CPU in a process that trains or predicts."""

import ctypes
import sys

import torch

# Parameters of glibc's mallopt, from malloc.h.
M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4


def use_cpu(threads: int) -> None:
    """Set torch's threads, and keep freed memory in the process.

    By default glibc gives large blocks back to the system as soon as they are free. Every step of training then
    gets its tensors page by page from the kernel again, which takes up to a quarter of its time.
    """
    torch.set_num_threads(threads)
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:  # other C libraries have no such function, or none that does this
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_MMAP_MAX, 0)
