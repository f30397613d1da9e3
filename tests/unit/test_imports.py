"""Imports run one way, as docs/architecture.md says: no part of the backend asks one that stands on it."""

from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import backend
from tests.backend_imports import imported_by

BACKEND = Path(backend.__file__).parent


def imports_of(source: Path) -> set[Path]:
    """Paths below the backend, without suffixes."""
    return {path.relative_to(BACKEND).with_suffix("") for path in imported_by(source)}


def modules_in(folder: str) -> list[Path]:
    return sorted((BACKEND / folder).rglob("*.py"))


BELOW_STAGES = {"maths", "kernels", "scene", "errors", "images"}
RULES = {
    "kernels": set(),
    "wire": set(),
    "maths": {"kernels", "scene", "errors"},
    "report_page": BELOW_STAGES,
    "stages": BELOW_STAGES | {"report_page", "mesh_files", "point_methods", "wire"},
}


@pytest.mark.parametrize(("folder", "others"), RULES.items())
def test_a_folder_asks_only_what_it_stands_on(folder: str, others: set[str]) -> None:
    assert modules_in(folder)
    asked = {path.parts[0] for source in modules_in(folder) for path in imports_of(source)}
    assert asked <= others | {folder}


def test_no_two_parts_of_the_stages_ask_each_other() -> None:
    """A part is a folder, or a module that lies in none."""
    asked_by: dict[str, set[str]] = {}
    for source in modules_in("stages"):
        part = source.relative_to(BACKEND / "stages").with_suffix("").parts[0]
        asked = {path.parts[1] for path in imports_of(source) if path.parts[0] == "stages"}
        asked_by.setdefault(part, set()).update(asked - {part})
    assert asked_by["mesh"] >= {"surface", "measurements"}
    TopologicalSorter(asked_by).prepare()  # raises CycleError
