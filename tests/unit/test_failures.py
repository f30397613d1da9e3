"""What users are told: in words that are right on the command line and in Blender's panel."""

import ast
import errno
import re
from pathlib import Path

import pytest

from backend.failures import explain_or_none, internal_error

BACKEND = Path(__file__).resolve().parents[2] / "backend"
SHARED = [path for path in sorted(BACKEND.rglob("*.py")) if "benchmark" not in path.as_posix()]
"""What Blender starts too; the benchmark is a command alone."""
OF_A_SHELL = re.compile(r"--[a-z]|`|pip install|(?<!\()\bdoctor\b")


def sentences(path: Path) -> list[str]:
    """The texts of what the module raises or says at its end."""
    names = {"ReconstructionError", "_unusable", "Failed", "_damaged", "_not_usable"}
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and getattr(node.func, "id", getattr(node.func, "attr", "")) in names:
            words = [*node.args, *(keyword.value for keyword in node.keywords)]
            texts = [leaf for word in words for leaf in ast.walk(word) if isinstance(leaf, ast.Constant)]
            found += [leaf.value for leaf in texts if isinstance(leaf.value, str)]
    return found


def test_there_is_something_to_look_at() -> None:
    assert sum(len(sentences(path)) for path in SHARED) > 100


@pytest.mark.parametrize("path", [pytest.param(path, id=path.stem) for path in SHARED if sentences(path)])
def test_no_sentence_speaks_of_a_shell(path: Path) -> None:
    assert [text for text in sentences(path) if OF_A_SHELL.search(text)] == []


@pytest.mark.parametrize(
    "error",
    [MemoryError(), OSError(errno.ENOSPC, "full"), ImportError("no torch", name="torch"), KeyError("x")],
)
def test_no_promise_that_only_some_commands_keep(error: Exception) -> None:
    """Rendering, fitting points and installing keep no stages, and have no log.txt."""
    told = explain_or_none(error) or internal_error(error)
    assert "kept" not in told.remedy
    assert "log.txt" not in told.remedy or "of a reconstruction" in told.remedy
    assert not OF_A_SHELL.search(told.remedy)


def test_a_list_of_files_in_one_word_is_no_fault_of_the_program() -> None:
    with pytest.raises(OSError, match="too long") as caught:
        Path("a.jpg " * 50).is_file()
    known = explain_or_none(caught.value)
    assert known is not None
    assert "a.jpg a.jpg" in known.text
    assert "too long" in known.text


def test_what_may_not_be_opened_is_named() -> None:
    known = explain_or_none(PermissionError(errno.EACCES, "Permission denied", "theirs/cameras.json"))
    assert known is not None
    assert known.text == "theirs/cameras.json cannot be looked at (Permission denied)."
