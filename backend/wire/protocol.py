"""What the backend and its caller say to each other: one JSON object a line, decoded strictly.

The backend speaks first: `Hello`, then any of `Stage`, `Progress`, `Preview`, `Checked`, `Warned`,
`Heartbeat`, then exactly one `Finished` or `Failed`, which is the last line. The caller may write
`Cancel`; closing the pipe says the same. Large data travels by file path. Standard library only: both
sides import this one file, so neither can misspell the other.
"""

import json
import math
import os
import types
import typing
from collections.abc import Callable
from dataclasses import MISSING, asdict, dataclass, fields
from reprlib import repr as shown

T = typing.TypeVar("T")

PROTOCOL_VERSION = 1
HEARTBEAT_S = 4.0
"""Longest silence of a healthy backend; the promise to the caller is 5 s."""

PRESETS = (
    "fast",
    "balanced",
    "detailed",
    "nerf",
    "neus",
    "sparsecraft",
    "neus-published",
    "sparsecraft-published",
)
DEVICES = ("auto", "cpu", "cuda", "mps")
UNTIL = ("cameras", "report")
LARGEST_SEED = 2**31 - 1
LARGEST_LENGTH = 1e9
"""Of what a region may measure in either direction, in world units."""

CANCELLED = "cancelled"
"""Code of a `Failed` that the user asked for."""
CRASHED = "crashed"
"""Code of a `Failed` that the caller's side made up, because the backend ended without a last word."""
PROTOCOL_BROKEN = "protocol_broken"
"""Code of a `Failed` that the caller's side made up, because a line could not be understood."""


class ProtocolError(ValueError):
    """A line that this version of the protocol does not allow."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One reconstruction, as the caller writes it to job.json; relative paths start at that file."""

    protocol: int
    images: tuple[str, ...]
    """Image files, or folders of them."""
    output: str
    cameras: str | None = None
    masks: str | None = None
    preset: str = "balanced"
    device: str = "auto"
    seed: int = 0
    truth: str | None = None
    region_centre: tuple[float, ...] | None = None
    """Of the sphere to reconstruct, three numbers in the frame of the cameras; None to find it."""
    region_radius: float | None = None
    cut_out: bool = False
    """Whether the subject is cut out of the photographs that have no masks."""
    without_ground: bool = False
    """Whether the flat ground that the subject stands on is left out."""
    budget_s: float | None = None
    """Time for fitting the surface; None for as long as the preset needs."""
    until: str = "report"
    """The last stage: "cameras" finds cameras and region and ends."""
    keep_stages: bool = True
    """Whether finished stages stay on the disk when all is done, for a later job in the same folder."""


@dataclass(frozen=True, kw_only=True)
class Hello:
    """First line."""

    protocol: int
    backend: str
    """Version of the program."""
    python: str
    pid: int


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A stage begins; index counts from 1."""

    name: str
    index: int
    count: int


@dataclass(frozen=True, kw_only=True)
class Progress:
    """How far the stage is, 0 to 1; a later one replaces an earlier one."""

    stage: str
    fraction: float
    text: str
    remaining_s: float | None
    """Estimated time to the end of the stage; None where nothing can be said yet."""


@dataclass(frozen=True, kw_only=True)
class Preview:
    """A file that shows the result so far: cameras as a .json, points or a mesh as a .ply."""

    path: str


@dataclass(frozen=True, kw_only=True)
class Checked:
    """One thing that `doctor` looked at."""

    name: str
    fine: bool
    found: str
    """A version, a device or what is wrong."""


@dataclass(frozen=True, kw_only=True)
class Warned:
    """The run goes on, and the user should know this."""

    text: str


@dataclass(frozen=True, kw_only=True)
class Heartbeat:
    """The backend lives; sent when nothing else is said for a while."""

    elapsed_s: float


@dataclass(frozen=True, kw_only=True)
class Finished:
    """Last line of a run that gave a result; `files` are names inside `output`."""

    output: str
    files: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Failed:
    """Last line of a run that did not: a code of errors.py (or one above), a sentence and a remedy."""

    code: str
    text: str
    remedy: str


@dataclass(frozen=True, kw_only=True)
class Cancel:
    """From the caller: stop, and keep what is done."""


Message = Hello | Stage | Progress | Preview | Checked | Warned | Heartbeat | Finished | Failed | Cancel
MESSAGES: dict[str, Callable[..., Message]] = {
    kind.__name__.lower(): kind for kind in typing.get_args(Message)
}


def encode(message: Message) -> str:
    """The message as one line, without the line break; ValueError on a number that is not finite."""
    fields_of = {"type": type(message).__name__.lower(), **asdict(message)}
    return json.dumps(fields_of, allow_nan=False, ensure_ascii=True)


def decode(line: str) -> Message:
    """The message of a line; ProtocolError unless it is exactly what `encode` writes."""
    found = _json_object(line)
    name = found.pop("type", None)
    if not isinstance(name, str) or name not in MESSAGES:
        raise ProtocolError(f"unknown message type {shown(name)}; known: {', '.join(MESSAGES)}")
    kind = MESSAGES[name]
    if kind is Hello:
        check_version(found.get("protocol"))  # first: another version may have other fields
    return _record(kind, found, name)


def encode_job(job: Job) -> str:
    """The content of job.json; ProtocolError on a number that is not finite."""
    try:
        return json.dumps(asdict(job), indent=2, allow_nan=False, ensure_ascii=True) + "\n"
    except ValueError as error:
        raise ProtocolError("job: a number is not finite") from error


def decode_job(text: str) -> Job:
    """The job of a job.json; ProtocolError with what is wrong otherwise."""
    found = _json_object(text)
    check_version(found.get("protocol"))
    job = _record(Job, found, "job")
    choices = (("preset", job.preset, PRESETS), ("device", job.device, DEVICES), ("until", job.until, UNTIL))
    for name, value, known in choices:
        if value not in known:
            raise ProtocolError(f"job: {name} is {shown(value)}; known: {', '.join(known)}")
    if not 0 <= job.seed <= LARGEST_SEED:
        raise ProtocolError(f"job: seed is {shown(job.seed)}; it must be from 0 to {LARGEST_SEED}")
    if job.budget_s is not None and job.budget_s <= 0:
        raise ProtocolError(f"job: budget_s is {job.budget_s}; it must be positive")
    _check_region(job)
    return job


def check_paths(job: Job) -> None:
    """ProtocolError for one that no file can have: who only looks at a job need not mind."""
    named = {name: getattr(job, name) for name in ("output", "cameras", "masks", "truth")}
    for name, path in (*(("images", image) for image in job.images), *named.items()):
        if path is not None and not path:
            raise ProtocolError(f"job: {name} is empty")
        if path is not None and not is_path(path):
            raise ProtocolError(f"job: {path!r} has a letter that the path of a file cannot have")


def is_path(text: str) -> bool:
    """Whether a file may be called so: not with a zero, or half of a pair, which JSON can tell."""
    try:
        return b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        return False


def _check_region(job: Job) -> None:
    """ProtocolError unless the region is left out or a sphere of sensible numbers."""
    centre, radius = job.region_centre, job.region_radius
    if centre is None and radius is None:
        return
    if centre is None or radius is None or len(centre) != 3:
        raise ProtocolError("job: region_centre (three numbers) and region_radius go together")
    if max(map(abs, centre)) > LARGEST_LENGTH or not 1 / LARGEST_LENGTH <= radius <= LARGEST_LENGTH:
        raise ProtocolError(f"job: the region at {centre} with radius {radius} is too large or too small")


def check_version(found: object) -> None:
    """ProtocolError when the other side speaks another version of the protocol."""
    if found != PROTOCOL_VERSION or isinstance(found, bool):
        raise ProtocolError(f"the other side speaks protocol {shown(found)}, this one {PROTOCOL_VERSION}")


def _json_object(text: str) -> dict[str, object]:
    """The JSON object of a text, without repeated keys and numbers that JSON does not have."""

    def no_constant(name: str) -> object:
        raise ProtocolError(f"{name} is not a JSON number")

    def no_repeats(pairs: list[tuple[str, object]]) -> dict[str, object]:
        if len(dict(pairs)) < len(pairs):
            raise ProtocolError("a key is repeated")
        return dict(pairs)

    try:
        found = json.loads(text, parse_constant=no_constant, object_pairs_hook=no_repeats)
    except ProtocolError:
        raise
    except (ValueError, RecursionError) as error:  # ValueError: no JSON, or a number of thousands of digits
        raise ProtocolError(f"not JSON: {text[:80]!r}") from error
    if not isinstance(found, dict):
        raise ProtocolError(f"not a JSON object: {text[:80]!r}")
    return found


def _record(kind: Callable[..., T], found: dict[str, object], name: str) -> T:
    """A record of the given dataclass with exactly its fields, each of the annotated type."""
    hints = typing.get_type_hints(kind)
    missing = [f.name for f in fields(typing.cast(typing.Any, kind)) if f.default is MISSING]
    missing = [field for field in missing if field not in found]
    unknown = [field for field in found if field not in hints]
    if missing or unknown:
        raise ProtocolError(f"{name}: missing {missing}, unknown {shown(unknown)}; known: {list(hints)}")
    return kind(**{field: _value(hints[field], value, f"{name}.{field}") for field, value in found.items()})


def _value(hint: object, value: object, where: str) -> object:
    """The value as the annotation asks for it; nothing is converted except a list into a tuple."""
    if isinstance(hint, types.UnionType):
        (hint,) = (part for part in typing.get_args(hint) if part is not types.NoneType)
        return None if value is None else _value(hint, value, where)
    if typing.get_origin(hint) is tuple:
        if not isinstance(value, list):
            raise ProtocolError(f"{where} is {shown(value)}, expected a list")
        item_hint = typing.get_args(hint)[0]
        return tuple(_value(item_hint, item, where) for item in value)
    if hint is float and type(value) in (int, float):
        return _finite(value, where)
    if type(value) is not hint:  # exact: a bool is no int
        raise ProtocolError(f"{where} is {shown(value)}, expected {getattr(hint, '__name__', hint)}")
    return value


def _finite(value: typing.Any, where: str) -> float:
    """The number, for which JSON writers may drop the ".0"; 1e999 is read as infinity."""
    try:
        if math.isfinite(value):
            return float(value)
    except OverflowError:  # an int
        pass
    raise ProtocolError(f"{where} is larger than any float")
