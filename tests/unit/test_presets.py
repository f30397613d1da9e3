"""Presets: the names agree everywhere, each is a real choice, and no setting is dead."""

import ast
import dataclasses
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from backend.doctor import DEPENDENCIES
from backend.pipeline import FITS
from backend.presets import PRESETS, Settings
from backend.stages.train.surface_fit import TrainConfig
from backend.version import VERSION
from backend.wire import protocol

ROOT = Path(__file__).resolve().parents[2]


def test_the_wire_and_the_presets_know_the_same_names() -> None:
    assert tuple(PRESETS) == protocol.PRESETS
    assert protocol.Job(protocol=1, images=(), output="").preset in PRESETS


def test_presets_differ_from_each_other() -> None:
    assert len(set(PRESETS.values())) == len(PRESETS)


def test_more_detail_means_larger_pictures_finer_grids_and_more_faces() -> None:
    def effort(settings: Settings) -> tuple[int, int, int]:
        assert isinstance(settings.train, TrainConfig)
        return settings.photos.max_side_px, max(settings.train.levels), settings.mesh.max_faces

    fast, balanced, detailed = (effort(PRESETS[name]) for name in ("fast", "balanced", "detailed"))
    assert all(a < b < c for a, b, c in zip(fast, balanced, detailed, strict=True))


OF_SURFACES = {name: train for name in PRESETS if isinstance(train := PRESETS[name].train, TrainConfig)}


def test_every_preset_can_be_fitted() -> None:
    assert {type(preset.train) for preset in PRESETS.values()} == set(FITS)


@pytest.mark.parametrize("name", OF_SURFACES)
def test_each_level_of_a_preset_has_its_steps(name: str) -> None:
    train = OF_SURFACES[name]
    assert len(train.levels) == len(train.steps) == len(train.rounds)
    assert list(train.levels) == sorted(set(train.levels))


def records(settings: object) -> Iterator[tuple[str, object]]:
    """Every settings record within one, with the name of the field that holds it."""
    for field in dataclasses.fields(settings):  # type: ignore[arg-type]
        if dataclasses.is_dataclass(held := getattr(settings, field.name)):
            yield field.name, held
            yield from records(held)


HELD = {name: type(held).__name__ for preset in PRESETS.values() for name, held in records(preset)}
"""Record by the field that holds it; "train" is of several kinds and known by annotations alone."""
OWNED = {
    (type(record).__name__, field.name)
    for preset in PRESETS.values()
    for _, record in records(preset)
    for field in dataclasses.fields(record)  # type: ignore[arg-type]
}


def settings_read(node: ast.AST, known: dict[str, str]) -> Iterator[tuple[str, str]]:
    """(record, field) of all attributes read below a node; `known` is the record of each local name.

    A name is known by its annotation, or by what it is assigned from; an attribute by the field's name.
    """
    if isinstance(node, ast.FunctionDef):
        known = known | {
            argument.arg: ast.unparse(argument.annotation).split(" ")[0].split(".")[-1]
            for argument in (*node.args.args, *node.args.kwonlyargs)
            if argument.annotation is not None
        }
    elif isinstance(node, ast.ClassDef):
        known = known | {"self": node.name}
    elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Attribute):
        known.update({ast.unparse(target): HELD.get(node.value.attr, "") for target in node.targets})
    elif isinstance(node, ast.Attribute):
        owner = node.value
        if isinstance(owner, ast.Name):
            yield known.get(owner.id, ""), node.attr
        elif isinstance(owner, ast.Attribute):
            yield HELD.get(owner.attr, ""), node.attr
    for child in ast.iter_child_nodes(node):
        yield from settings_read(child, known)


@cache
def all_settings_read() -> frozenset[tuple[str, str]]:
    files = (ROOT / "backend").rglob("*.py")
    return frozenset(read for path in files for read in settings_read(ast.parse(path.read_text()), {}))


@pytest.mark.parametrize(("record", "field"), sorted(OWNED))
def test_every_setting_is_read(record: str, field: str) -> None:
    """By its record too: another record's field of the same name does not count."""
    assert (record, field) in all_settings_read()


def numbers(value: object) -> Iterator[float]:
    """Every number of a setting, also within tuples."""
    if isinstance(value, int | float):
        yield float(value)
    elif isinstance(value, tuple):
        for part in value:
            yield from numbers(part)


@pytest.mark.parametrize("name", PRESETS)
def test_numbers_of_a_preset_are_finite_and_none_is_negative(name: str) -> None:
    for owner, record in records(PRESETS[name]):
        for field in dataclasses.fields(record):  # type: ignore[arg-type]
            for number in numbers(getattr(record, field.name)):
                assert 0 <= number < float("inf"), (owner, field.name)


def test_settings_are_told_apart_by_their_representation() -> None:
    """Checkpoints are found by it."""
    for preset in PRESETS.values():
        for field in dataclasses.fields(preset):
            assert "object at 0x" not in repr(getattr(preset, field.name))


def test_the_version_is_the_same_everywhere() -> None:
    assert tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"] == VERSION
    assert tomllib.loads((ROOT / "blender_manifest.toml").read_text())["version"] == VERSION


def test_doctor_knows_every_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert {line.split(">=")[0] for line in project["dependencies"]} == set(DEPENDENCIES.values())
    assert list(DEPENDENCIES).index("PIL") < list(DEPENDENCIES).index("pycolmap")


def test_the_tested_versions_are_in_the_allowed_ranges_and_carry_no_address() -> None:
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert pinned["torch"] == "2.13.0"
    names = {name.lower().replace("_", "-") for name in pinned}
    assert set(DEPENDENCIES.values()) <= names
    assert not any("://" in line or "@" in line or "+" in line for line in lines)
