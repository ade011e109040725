"""Warp, initialised without telling everybody that this machine has no GPU."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import warp as wp

__all__ = ["wp"]


@contextmanager
def _native_messages_dropped() -> Iterator[None]:
    """Warp's native library writes straight to file descriptor 2, whatever its log level."""
    if sys.stderr is None:  # closed by whoever started this: nothing can be heard
        yield
        return
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


wp.config.log_level = wp.LOG_ERROR
with _native_messages_dropped():
    wp.init()
