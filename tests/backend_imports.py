"""What modules of the backend import of each other, read from their source."""

import ast
from pathlib import Path


def imported_by(source: Path) -> set[Path]:
    """The files of the backend that a module names in its imports."""
    found: set[Path] = set()
    for node in ast.walk(ast.parse(source.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.level:
            place = source.parents[node.level - 1].joinpath(*(node.module or "").split("."))
            named = [place.with_suffix(".py"), *(place / f"{alias.name}.py" for alias in node.names)]
            found |= {path for path in named if path.is_file()}
    return found
