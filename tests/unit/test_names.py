"""Every global name that the backend asks for is there: for axis names in strings, linters do not ask."""

import builtins
import dis
import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path
from types import CodeType

import pytest

import backend

MODULES = sorted(
    module.name
    for module in pkgutil.walk_packages(backend.__path__, "backend.")
    if not module.name.endswith("__main__")
)


def parts(code: CodeType) -> Iterator[CodeType]:
    """The code, and all code inside it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from parts(constant)


@pytest.mark.parametrize("name", MODULES)
def test_names_are_there(name: str) -> None:
    module = importlib.import_module(name)
    assert module.__file__ is not None
    code = compile(Path(module.__file__).read_text(encoding="utf-8"), module.__file__, "exec")
    instructions = [each for part in parts(code) for each in dis.get_instructions(part)]
    asked = {each.argval for each in instructions if each.opname in ("LOAD_GLOBAL", "LOAD_NAME")}
    # names of a class are its own, and what it notes of their types
    stored = {each.argval for each in instructions if each.opname == "STORE_NAME"}
    assert asked <= vars(module).keys() | vars(builtins).keys() | stored | {"__annotations__"}
