"""What made a number: the commit of the code, and the machine."""

import os
import platform
import subprocess
from functools import cache
from pathlib import Path


@cache  # what a process has imported stays what it was when it was asked first
def commit() -> str | None:
    """The commit of the checkout that this code runs from, marked if files that it has differ.

    None if the package is installed, or there is no git.
    """
    checkout = Path(__file__).parents[1]
    if not (checkout / "pyproject.toml").is_file():
        return None
    git = ["git", "-C", str(checkout)]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True)
        # What the leaderboard holds is what is being made: it changes no number.
        code = [".", ":!leaderboard/records", ":!leaderboard/checkpoints", ":!leaderboard/*.md"]
        status = subprocess.run(
            [*git, "status", "--porcelain", "-uno", "--", *code], capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return head.stdout.strip() + ("+changes" if status.stdout.strip() else "")


def machine() -> str:
    """The processor and its number of cores."""
    names = Path("/proc/cpuinfo")
    lines = names.read_text().splitlines() if names.is_file() else []
    model = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    return f"{model or platform.processor() or platform.machine()}, {os.cpu_count()} cores"
