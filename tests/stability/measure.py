"""Makes the table of docs/stability.md: `python -m tests.stability.measure` from the repository's root."""

from pathlib import Path

import torch

from tests.stability import (
    test_distance_gradients,
    test_meshes,
    test_neus_weights,
    test_sampling,
    test_volume_rendering,
    test_windows,
)
from tests.stability.sweep import Sweep, by_case

PAGE = Path(__file__).resolve().parents[2] / "docs" / "stability.md"
BEGIN, END = "<!-- measured: begin -->\n", "<!-- measured: end -->\n"

SECTIONS: dict[str, tuple[Sweep, ...]] = {
    "Volume rendering": test_volume_rendering.SWEEPS,
    "NeuS weights": test_neus_weights.SWEEPS,
    "Distances, gradients, losses": test_distance_gradients.SWEEPS,
    "Sampling and encoding": test_sampling.SWEEPS,
    "Windows of pictures": test_windows.SWEEPS,
    "Meshes": test_meshes.SWEEPS,
}


def table() -> str:
    """Every sweep with its largest errors, as Markdown."""
    lines = [
        "| what, over which cases | usual formula | its error | error here | test allows |",
        "|---|---|---|---|---|",
    ]
    for title, sweeps in SECTIONS.items():
        lines.append(f"| **{title}** | | | | |")
        lines += [row(sweep) for sweep in sweeps]
    return "\n".join(lines) + "\n"


def row(sweep: Sweep) -> str:
    """One line of the table, with the largest errors of all cases."""
    errors = (max(by_case(sweep.usual()).values()), max(by_case(sweep.ours()).values()), sweep.tolerance)
    cells = [text.replace("|", "\\|") for text in (sweep.what, sweep.usual_formula)]
    return "| " + " | ".join([*cells, *(_told(error) for error in errors)]) + " |"


def _told(error: float) -> str:
    return "not finite" if error == float("inf") else f"{error:.1e}" if error else "0"


def with_table(page: str, measured: str) -> str:
    """The page with the table between its marks."""
    before, rest = page.split(BEGIN)
    return before + BEGIN + measured + END + rest.split(END)[1]


if __name__ == "__main__":
    torch.set_num_threads(1)
    PAGE.write_text(with_table(PAGE.read_text(encoding="utf-8"), table()), encoding="utf-8")
