"""Frozen records as files: any frozen dataclass of arrays and plain values, driven by its annotations.

One `.npz` holds the arrays and, as JSON, everything else. No pickle: a checkpoint is data, never code.
Allowed are numpy arrays (also with jaxtyping shapes, which are checked on loading), str, int, float, bool,
None, Path, `X | None`, tuples and such dataclasses in each other.
"""

import json
import os
import types
import typing
import zipfile
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np

from .held_files import written_whole

T = typing.TypeVar("T")
_STRUCTURE = "structure"
_PLAIN = (str, int, float, bool)


class RecordUnreadable(ValueError):  # noqa: N818 - a state of a file; the caller decides what it means
    """A file that holds no record of the wanted type: damaged, or from other code."""


def save_record(path: Path, record: object, hint: object, *, note: str = "") -> None:
    """Write the record atomically: the file is complete or not there. `note` is kept beside it.

    `hint` is the record's annotation, for example `tuple[Photo, ...]`. Raises TypeError for a value that
    the annotation does not allow, OSError where the disk does not.
    """
    arrays: list[np.ndarray] = []
    structure = json.dumps({"note": note, "record": _encode(record, hint, "record", arrays)})
    members = {f"array_{index}": array for index, array in enumerate(arrays)}
    members[_STRUCTURE] = np.frombuffer(structure.encode(), np.uint8)
    with written_whole(path) as part, part.open("wb") as file:
        np.savez(file, allow_pickle=False, **members)
        file.flush()
        os.fsync(file.fileno())


def load_record(path: Path, hint: type[T]) -> T:
    """The record that save_record wrote under the same annotation; RecordUnreadable otherwise."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            structure = json.loads(file[_STRUCTURE].tobytes())
            members = {name: file[name] for name in file.files}
        record: T = _decode(structure["record"], hint, "record", members)
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, EOFError, OSError) as error:
        raise RecordUnreadable(f"{path.name}: {error}") from error
    return record


def read_note(path: Path) -> str | None:
    """The note of a record's file without reading its arrays; None where there is no readable file."""
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return str(json.loads(file[_STRUCTURE].tobytes())["note"])
    except (zipfile.BadZipFile, KeyError, ValueError, TypeError, EOFError, OSError):
        return None


def _encode(value: object, hint: object, where: str, arrays: list[np.ndarray]) -> object:
    """The value as JSON; arrays go to the end of `arrays` and leave their index."""
    hint = _without_none(hint, value)
    if value is None and hint is types.NoneType:
        return None
    if _is_array(hint) and isinstance(value, np.ndarray) and value.dtype != object:
        arrays.append(value)
        return len(arrays) - 1
    if typing.get_origin(hint) is tuple and isinstance(value, tuple):
        items = zip(value, _item_hints(hint, len(value), where), strict=True)
        return [_encode(item, of, f"{where}[{index}]", arrays) for index, (item, of) in enumerate(items)]
    if isinstance(hint, type) and is_dataclass(hint) and type(value) is hint:
        hints = typing.get_type_hints(hint)
        return {
            field.name: _encode(
                getattr(value, field.name), hints[field.name], f"{where}.{field.name}", arrays
            )
            for field in fields(hint)
        }
    if hint is Path and isinstance(value, Path):
        return str(value)
    if hint is float and isinstance(value, float | int) and type(value) is not bool:
        return float(value)
    if hint in _PLAIN and type(value) is hint:
        return value
    raise TypeError(f"{where} is {type(value).__name__}, its annotation {hint} cannot be stored")


def _decode(stored: object, hint: object, where: str, members: dict[str, np.ndarray]) -> typing.Any:
    """Inverse of _encode."""
    hint = _without_none(hint, stored)
    if stored is None and hint is types.NoneType:
        return None
    if _is_array(hint) and type(stored) is int:
        array = members[f"array_{stored}"]
        if hint is not np.ndarray and not isinstance(array, typing.cast(type, hint)):
            raise TypeError(f"{where} is {array.dtype}{array.shape}, expected {hint}")
        return array
    if typing.get_origin(hint) is tuple and isinstance(stored, list):
        items = zip(stored, _item_hints(hint, len(stored), where), strict=True)
        return tuple(
            _decode(item, of, f"{where}[{index}]", members) for index, (item, of) in enumerate(items)
        )
    if isinstance(hint, type) and is_dataclass(hint) and isinstance(stored, dict):
        hints = typing.get_type_hints(hint)
        if set(stored) != {field.name for field in fields(hint)}:
            raise TypeError(f"{where} has the fields {sorted(stored)}")
        return hint(**{n: _decode(item, hints[n], f"{where}.{n}", members) for n, item in stored.items()})
    if hint is Path and isinstance(stored, str):
        return Path(stored)
    if hint in _PLAIN and type(stored) is hint:
        return stored
    raise TypeError(f"{where} is {type(stored).__name__}, expected {hint}")


def _is_array(hint: object) -> bool:
    """Whether the annotation means a numpy array, plain or with a jaxtyping shape."""
    return hint is np.ndarray or getattr(hint, "array_type", None) is np.ndarray


def _without_none(hint: object, value: object) -> object:
    """X of `X | None` for a value that is there, NoneType for one that is not, else the annotation."""
    if not isinstance(hint, types.UnionType) and typing.get_origin(hint) is not typing.Union:
        return hint
    parts = typing.get_args(hint)
    if value is None and types.NoneType in parts:
        return types.NoneType
    others = [part for part in parts if part is not types.NoneType]
    return others[0] if len(others) == 1 else hint


def _item_hints(hint: object, length: int, where: str) -> tuple[object, ...]:
    """The annotation of each item of a tuple."""
    hints = typing.get_args(hint)
    if len(hints) == 2 and hints[1] is Ellipsis:
        return (hints[0],) * length
    if len(hints) != length:
        raise TypeError(f"{where} has {length} items, expected {len(hints)}")
    return hints
