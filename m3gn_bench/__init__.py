"""m3gn-bench: regenerate the five M3GN tasks with open simulators and score learned simulators on them."""

from pathlib import Path

from m3gn_bench.version import __version__

__all__ = ["__version__"]

# In a source checkout the other rooms are siblings of this folder (package-dir in pyproject.toml), not
# children of it. Without this, a Python started in the checkout would find this folder but not the rooms.
_checkout = Path(__file__).resolve().parent.parent
if (_checkout / "pyproject.toml").is_file():
    __path__.append(str(_checkout))
