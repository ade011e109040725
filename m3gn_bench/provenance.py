"""What made a number: the commit of the code, and the machine."""

import hashlib
import os
import platform
import subprocess
from functools import cache
from pathlib import Path

# What the leaderboard holds is what is being made: it changes no number.
CODE = [".", ":!leaderboard/records", ":!leaderboard/checkpoints", ":!leaderboard/*.md"]


@cache  # what a process has imported stays what it was when it was asked first
def commit() -> str | None:
    """The commit of the checkout that this code runs from, marked if files that it has differ.

    None if the package is installed, or there is no git.
    """
    head = _git("rev-parse", "HEAD")
    return head and head.strip() + ("+changes" if changes() else "")


@cache
def changes() -> str:
    """A hash of what differs from that commit; empty if nothing does."""
    difference = _git("diff", "HEAD", "--", *CODE)
    return hashlib.sha256(difference.encode()).hexdigest()[:16] if difference else ""


def _git(*arguments: str) -> str | None:
    """What git prints of the checkout that this code runs from; None where there is none."""
    checkout = Path(__file__).parents[1]
    if not (checkout / "pyproject.toml").is_file():
        return None
    try:
        done = subprocess.run(
            ["git", "-C", str(checkout), *arguments],
            capture_output=True,
            text=True,
            errors="replace",
            check=True,
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout


def usable_cores() -> int:
    """How many this process may use: on a cluster, fewer than there are."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def machine() -> str:
    """The processor and its number of cores."""
    names = Path("/proc/cpuinfo")
    lines = names.read_text().splitlines() if names.is_file() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    return f"{model or platform.processor() or platform.machine()}, {os.cpu_count()} cores"
