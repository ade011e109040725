"""Read pickles of strangers: numbers, words, plain containers and numpy arrays, and nothing that could run.

A pickle is a program: it may ask for any function by its name and call it. Here it gets, for the few names that
numpy writes, functions of this module that rebuild arrays of plain numbers; any other name ends the reading before
anything is called. Nothing of what numpy's own functions would accept (objects at an address, for example)
reaches them unchecked.
"""

import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.imports.source import reading

PLAIN_KINDS = "biuf"  # of numpy types: truth values, integers, floats


class _DataType:
    """Stands for a numpy type while its parts arrive."""

    def __init__(self, code: str, *flags: object) -> None:
        self.code, self.order = code, "|"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.order = state[1]

    @property
    def is_object(self) -> bool:
        return self.code in ("O", "O8")

    def real(self) -> np.dtype:
        """The numpy type. Raises UnpicklingError unless it is one of plain numbers."""
        found = np.dtype(self.code)
        if found.kind not in PLAIN_KINDS or self.order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError(f"array of type {self.code!r}")
        return found.newbyteorder(self.order)  # type: ignore[arg-type]  # one of the four


class _Array(np.ndarray):
    """An array while its parts arrive; only plain types, or a list of what was read already."""

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        if kind.is_object and isinstance(content, list):
            real, number = np.dtype(object), len(content)
        else:
            real, content = kind.real(), bytes(content)
            number = len(content) // real.itemsize
        # numpy believes what it is told of a list's length, and reads on beyond its end.
        if any(type(length) is not int or length < 0 for length in shape) or math.prod(shape) != number:
            raise pickle.UnpicklingError(f"array of shape {shape} with {number} entries")
        super().__setstate__((1, shape, real, fortran, content))


class _Callable:
    """A function that a pickle may call and can do nothing else with, such as setting its attributes."""

    __slots__ = ("_function",)

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def __setstate__(self, state: object) -> None:
        raise pickle.UnpicklingError("a function with a state")


def _empty_array(kind: str, shape: object, code: object) -> np.ndarray:
    return np.ndarray.__new__(_Array, (0,), np.int8)


def _array_from_bytes(content: bytes, kind: _DataType, shape: tuple[int, ...], order: Any) -> np.ndarray:
    return np.frombuffer(bytes(content), kind.real()).reshape(shape, order=order)


def _scalar(kind: _DataType, content: bytes) -> np.generic:
    return np.frombuffer(content, kind.real())[0]


def _bytes_from_text(text: str, encoding: str) -> bytes:  # how protocol 2 stores bytes
    return text.encode("latin1")


def _no_bytes() -> bytes:  # how protocol 2 stores those of an empty array
    return b""


_BUILTINS = ("__builtin__", "builtins")  # before and since protocol 3
_NUMPY = ("numpy.core", "numpy._core")  # before and since numpy 2
ADMITTED: dict[tuple[str, str], Any] = {
    ("numpy", "ndarray"): "ndarray",  # a mere word: arrays are made by the functions below
    ("numpy", "dtype"): _Callable(_DataType),
    ("_codecs", "encode"): _Callable(_bytes_from_text),
    **{(module, "bytes"): _Callable(_no_bytes) for module in _BUILTINS},
    **{(module, "set"): _Callable(set) for module in _BUILTINS},
    **{(f"{core}.multiarray", "_reconstruct"): _Callable(_empty_array) for core in _NUMPY},
    **{(f"{core}.multiarray", "scalar"): _Callable(_scalar) for core in _NUMPY},
    **{(f"{core}.numeric", "_frombuffer"): _Callable(_array_from_bytes) for core in _NUMPY},
}


class _RefusedError(Exception):
    """A name that is not admitted."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        try:
            return ADMITTED[module, name]
        except KeyError:
            raise _RefusedError(f"{module}.{name}") from None


def read_pickle(path: Path) -> Any:
    """What a pickle holds, if that is numbers, words, plain containers and numpy arrays.

    Raises:
        DatasetError: it asks for anything else (which is named, and was not called), is damaged, or no pickle.
    """
    with reading(path), path.open("rb") as file:
        try:
            return _Unpickler(file).load()
        except _RefusedError as error:
            raise DatasetError(
                f"{path} asks for {error}, and was not read: only numpy arrays, numbers, words and plain containers "
                "are admitted, because a pickle can run anything"
            ) from None
        except Exception as error:  # a damaged pickle raises whatever its instructions happen to raise
            raise DatasetError(f"{path} is no pickle of plain arrays, or damaged ({error})") from error
