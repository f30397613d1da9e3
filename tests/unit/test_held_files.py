"""A file that is held for a moment is waited for on Windows, and nowhere else."""

from types import SimpleNamespace

import pytest

from backend import held_files
from backend.held_files import when_let_go


class Held:
    """A file that cannot be moved for the first so many tries."""

    def __init__(self, tries: int) -> None:
        self.tries = tries

    def move(self) -> str:
        self.tries -= 1
        if self.tries >= 0:
            raise PermissionError(13, "Permission denied")
        return "moved"


@pytest.fixture
def waited_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The waits on a Windows whose time costs nothing."""
    waits: list[float] = []
    monkeypatch.setattr(held_files, "sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr(held_files, "time", SimpleNamespace(sleep=waits.append))
    return waits


def test_a_file_that_is_let_go_is_moved(waited_s: list[float]) -> None:
    assert when_let_go(Held(2).move) == "moved"
    assert waited_s == [0.2, 0.5]


def test_a_file_that_stays_open_is_told(waited_s: list[float]) -> None:
    with pytest.raises(PermissionError):
        when_let_go(Held(99).move)
    assert sum(waited_s) < 5


def test_elsewhere_nobody_waits(waited_s: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_files, "sys", SimpleNamespace(platform="linux"))
    with pytest.raises(PermissionError):
        when_let_go(Held(1).move)
    assert not waited_s
