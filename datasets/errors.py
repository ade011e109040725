"""The root of all errors that a user may see: one clear line, no traceback."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic import ValidationError


class BenchError(Exception):
    """Something the user can act on. The message says what was wrong, where, and what to do."""

    def __init__(self, message: str) -> None:
        super().__init__(" ".join(message.split()))  # libraries whose errors are quoted here break lines


class DatasetError(BenchError):
    """A dataset file cannot be written, opened or trusted."""


def first_problem(error: "ValidationError", *within: str) -> str:
    """What pydantic found first, in a line: where (and within what that is), and what."""
    first = error.errors()[0]
    return ": ".join(filter(None, (".".join(map(str, (*within, *first["loc"]))), first["msg"])))


def unknown_name(kind: str, name: str, known: list[str]) -> str:
    """The message for a name that does not exist: always lists what does."""
    return f"unknown {kind} {name!r}; known: {', '.join(sorted(known))}"
