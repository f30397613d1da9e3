"""Settings come back in the order in which they depend on each other, whatever happened meanwhile."""

import pytest

from addon.kept_settings import changed


class Format:
    """As Blender's image settings: the kind decides which depths there are, and sets one."""

    DEPTHS = {"PNG": ("8", "16"), "EXR": ("32", "half")}  # noqa: RUF012

    def __init__(self) -> None:
        self._kind, self._depth = "EXR", "half"

    @property
    def kind(self) -> str:
        return self._kind

    @kind.setter
    def kind(self, kind: str) -> None:
        self._kind, self._depth = kind, self.DEPTHS[kind][0]

    @property
    def depth(self) -> str:
        return self._depth

    @depth.setter
    def depth(self, depth: str) -> None:
        if depth not in self.DEPTHS[self._kind]:
            raise TypeError(f"{depth} is not in {self.DEPTHS[self._kind]}")
        self._depth = depth


def test_they_are_changed_and_come_back() -> None:
    image = Format()
    with changed([(image, "kind", "PNG"), (image, "depth", "16"), (image, "since_blender_9", 1)]):
        assert (image.kind, image.depth) == ("PNG", "16")
    assert (image.kind, image.depth) == ("EXR", "half")
    assert not hasattr(image, "since_blender_9")


def test_they_come_back_after_an_error() -> None:
    image = Format()
    with pytest.raises(RuntimeError), changed([(image, "kind", "PNG"), (image, "depth", "16")]):
        raise RuntimeError
    assert (image.kind, image.depth) == ("EXR", "half")


def test_they_come_back_where_one_cannot_be_changed() -> None:
    image = Format()
    with pytest.raises(TypeError), changed([(image, "kind", "PNG"), (image, "depth", "32")]):
        pass
    assert (image.kind, image.depth) == ("EXR", "half")


class Stuck:
    """Something whose setting cannot be taken back."""

    kind = property(lambda _: "EXR", lambda self, kind: self.refuse(kind))

    def refuse(self, kind: str) -> None:
        if kind == "EXR":
            raise TypeError("stuck")


def test_one_that_cannot_come_back_does_not_keep_the_others() -> None:
    first, second = Stuck(), Format()
    with pytest.raises(TypeError, match="stuck"), changed([(first, "kind", "PNG"), (second, "kind", "PNG")]):
        assert second.kind == "PNG"
    assert second.kind == "EXR"
