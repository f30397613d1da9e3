"""What is kept under the code's fingerprint is done again after any change of what computes it."""

from pathlib import Path

import pytest

from backend import provenance
from backend.benchmark import measuring
from tests.backend_imports import imported_by

BACKEND = Path(provenance.__file__).parent
NOT_KEPT = {BACKEND / "stages" / "report.py", BACKEND / "stages" / "cameras" / "camera_report.py"}
"""Done in every run: what only they use changes nothing that is kept."""


def reached_from(sources: set[Path]) -> set[Path]:
    """These and all that they import, one by way of another."""
    known: set[Path] = set()
    while sources:
        known |= sources
        sources = set().union(*map(imported_by, sources)) - known
    return known


def test_every_module_that_a_kept_stage_uses_is_covered() -> None:
    stages = {*(BACKEND / "stages").rglob("*.py"), *(BACKEND / "maths").rglob("*.py")}
    assert stages >= NOT_KEPT
    stages -= NOT_KEPT
    reached = reached_from(stages)
    assert BACKEND / "kernels" / "patch_correlation.py" in reached
    assert reached <= set(provenance.computing_sources())


@pytest.mark.parametrize(
    "name",
    ["kernels/plane_fits.py", "maths/median.py", "stages/train/rims.py", "machine.py"],
)
def test_a_change_of_a_source_changes_the_fingerprint(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = BACKEND / name
    before = provenance.code_fingerprint.__wrapped__()
    (tmp_path / source.name).write_text(source.read_text(encoding="utf-8") + "\n# changed\n")
    changed = [tmp_path / source.name if path == source else path for path in provenance.computing_sources()]
    monkeypatch.setattr(provenance, "computing_sources", lambda: changed)
    assert provenance.code_fingerprint.__wrapped__() != before


@pytest.mark.parametrize("package", ["torch", "numba", "pycolmap", "numpy", "scipy", "fast-simplification"])
def test_another_version_of_a_package_changes_the_fingerprint(
    package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before, version = provenance.code_fingerprint.__wrapped__(), provenance.version
    monkeypatch.setattr(provenance, "version", lambda name: "0" if name == package else version(name))
    assert provenance.code_fingerprint.__wrapped__() != before


def test_what_measures_a_run_counts_for_what_a_benchmark_keeps() -> None:
    """All that a run's numbers pass through, but the cases, which count by value."""
    of_benchmark = {*(BACKEND / "benchmark").glob("*.py")} - {BACKEND / "benchmark" / "suites.py"}
    used = reached_from({Path(measuring.__file__)}) & {*of_benchmark, BACKEND / "mesh_files.py"}
    assert BACKEND / "benchmark" / "held_out.py" in used
    assert used <= {*measuring.measuring_sources(), *provenance.computing_sources()}


def test_a_change_of_what_measures_changes_the_measuring_fingerprint_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured, computed = measuring.measuring_fingerprint.__wrapped__(), provenance.code_fingerprint()
    first, *others = measuring.measuring_sources()
    (tmp_path / first.name).write_text(first.read_text(encoding="utf-8") + "\n# changed\n")
    monkeypatch.setattr(measuring, "measuring_sources", lambda: (tmp_path / first.name, *others))
    assert measuring.measuring_fingerprint.__wrapped__() != measured
    assert provenance.code_fingerprint.__wrapped__() == computed
