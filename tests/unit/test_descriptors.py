"""Features that look alike: who is found, and who is too much like another."""

import numpy as np
import pytest

from backend.maths.descriptors import matched_descriptors

RATIO = 0.8


def made(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places far apart, and descriptors as of gradients: many small numbers, some large."""
    places = 100.0 * np.arange(count)[:, None] + rng.uniform(0, 1, (count, 2))
    return places.astype(np.float32), np.minimum(rng.exponential(40, (count, 128)), 255).astype(np.uint8)


def blurred(rng: np.random.Generator, descriptors: np.ndarray) -> np.ndarray:
    """As another photograph shows the same."""
    noisy = descriptors + rng.normal(0, 8, descriptors.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def test_what_is_the_same_is_matched_and_nothing_else() -> None:
    """Also across the rows that are compared at a time."""
    rng = np.random.default_rng(0)
    places, descriptors = made(rng, 3000)
    other_places, others = made(rng, 3500)
    turned = rng.permutation(3500)[:2500]
    others[turned] = blurred(rng, descriptors[:2500])
    matches = matched_descriptors(places, descriptors, other_places, others, RATIO)
    assert {tuple(match) for match in matches} == set(enumerate(turned.tolist()))


@pytest.mark.parametrize(("at_its_place", "is_matched"), [(True, True), (False, False)])
def test_a_rival_is_of_another_place(at_its_place: bool, is_matched: bool) -> None:
    rng = np.random.default_rng(1)
    places, descriptors = made(rng, 50)
    other_places, others = made(rng, 50)
    others[7], others[30] = blurred(rng, descriptors[7]), blurred(rng, descriptors[7])
    others[8:30] = blurred(rng, descriptors[8:30])
    if at_its_place:
        other_places[30] = other_places[7]
    found = {tuple(match) for match in matched_descriptors(places, descriptors, other_places, others, RATIO)}
    assert ((7, 7) in found) == is_matched
    assert {(i, i) for i in range(8, 30)} <= found


def test_the_first_feature_of_a_place_stands_for_all_of_it_once() -> None:
    """Each of three looks of the one place is found again in one of three of the other's."""
    rng = np.random.default_rng(2)
    places, descriptors = made(rng, 60)
    other_places, others = made(rng, 60)
    others[:] = blurred(rng, descriptors)
    places[[20, 40]] = places[0]
    other_places[[20, 40]] = other_places[0]
    matches = matched_descriptors(places, descriptors, other_places, others, RATIO)
    assert sorted(map(tuple, matches)) == [(i, i) for i in range(60) if i not in (20, 40)]


def test_the_nearest_of_two_that_match_one_is_kept() -> None:
    rng = np.random.default_rng(3)
    places, descriptors = made(rng, 40)
    other_places, others = made(rng, 40)
    others[5] = descriptors[5]
    descriptors[6], places[6] = blurred(rng, descriptors[5]), places[5] + 1.0
    matches = matched_descriptors(places, descriptors, other_places, others, RATIO)
    assert matches.tolist() == [[5, 5]]


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_have_no_rivals_and_no_matches(count: int) -> None:
    rng = np.random.default_rng(4)
    few, many = made(rng, count), made(rng, 10)
    assert matched_descriptors(*few, *many, RATIO).shape == (0, 2)
    assert matched_descriptors(*many, *few, RATIO).shape == (0, 2)
