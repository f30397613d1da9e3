"""How far a job is: laws of the share, and words."""

from itertools import pairwise

import pytest

from addon.progress import seconds_left, stage_words, time_words, total_share

RUN = ["photos", "cameras", "region", "stereo", "train", "mesh", "report"]
CUT_OUT = ["photos", "cameras", "cutout", "region", "stereo", "train", "mesh", "report"]
FIT = ["points", "surface", "mesh"]


def shares(names: list[str]) -> list[float]:
    """The share at the beginning, middle and end of every stage of a run."""
    return [
        total_share(names[:index], name, len(names) - index - 1, fraction)
        for index, name in enumerate(names)
        for fraction in (0.0, 0.5, 1.0)
    ]


@pytest.mark.parametrize(
    "names", [RUN, RUN[:3], CUT_OUT, FIT, ["render"], ["python", "packages", "check"], ["a", "b", "c"]]
)
def test_it_goes_from_nothing_to_all_and_never_back(names: list[str]) -> None:
    found = shares(names)
    assert found[0] == 0.0
    assert found[-1] == pytest.approx(1.0)
    assert all(later >= earlier for earlier, later in pairwise(found))


@pytest.mark.parametrize("names", [RUN, CUT_OUT, FIT])
def test_a_stage_ends_where_the_next_begins(names: list[str]) -> None:
    found = shares(names)
    assert found[2:-1:3] == pytest.approx(found[3::3])


@pytest.mark.parametrize("num_left", [10**400, -(10**400)])
def test_a_number_of_stages_that_cannot_be_does_no_harm(num_left: int) -> None:
    assert 0.0 <= total_share([], "mesh", num_left, 0.5) <= 1.0


def test_time_left_at_a_steady_pace() -> None:
    assert seconds_left(0.25, 10.0) == pytest.approx(30.0)
    assert seconds_left(0.0, 10.0) is None
    assert seconds_left(1.0, 10.0) == 0.0


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.0, "5 s"), (17.0, "15 s"), (58.0, "1 min"), (600.0, "10 min"), (7200.0, "2.0 h")],
)
def test_time_in_words(seconds: float, words: str) -> None:
    assert time_words(seconds) == words


def test_every_stage_has_words() -> None:
    assert stage_words("stereo") == "Comparing photographs"
    assert stage_words("some_new_stage") == "Some new stage"
