"""How a mesh is laid out in a picture: neighbours, boxes that do not overlap, which face a texel is of."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from backend.maths.atlas import faces_at, neighbours, packed, spread
from backend.maths.raycast import RayCaster


def sphere() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=2)


def test_each_edge_of_a_closed_mesh_joins_two_faces() -> None:
    ball = sphere()
    pairs = neighbours(np.asarray(ball.faces, np.int64))
    expected = {tuple(sorted(pair)) for pair in ball.face_adjacency.tolist()}
    assert {tuple(sorted(pair)) for pair in pairs.T.tolist()} == expected
    assert pairs.shape[1] == len(expected)


def test_faces_that_share_nothing_have_no_neighbours() -> None:
    assert neighbours(np.arange(6, dtype=np.int64).reshape(2, 3)).shape == (2, 0)


def test_spreading_keeps_what_is_even_and_evens_out_the_rest() -> None:
    pairs = neighbours(np.asarray(sphere().faces, np.int64))
    count = len(sphere().faces)
    even = np.full((count, 2), 3.0)
    np.testing.assert_allclose(spread(even, pairs, 5), even)
    rough = np.random.default_rng(0).normal(size=(count, 1))
    once, often = spread(rough, pairs, 1), spread(rough, pairs, 20)
    assert often.std() < 0.5 * once.std() < 0.5 * rough.std()
    # each face of a closed mesh has three neighbours, so that no value is lost
    np.testing.assert_allclose(often.mean(), rough.mean())


def test_one_round_is_the_mean_of_a_face_and_its_neighbours() -> None:
    strip = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4]])
    found = spread(np.array([[0.0], [6.0], [0.0]]), neighbours(strip), 1)
    np.testing.assert_allclose(found, [[3.0], [2.0], [3.0]])


@given(st.lists(st.tuples(st.integers(1, 60), st.integers(1, 60)), min_size=1, max_size=40))
def test_boxes_do_not_overlap_and_the_picture_holds_them(sizes: list[tuple[int, int]]) -> None:
    boxes = np.array(sizes, np.int64)
    corners, (width, height) = packed(boxes)
    drawn = np.zeros((height, width), int)
    for (x, y), (across, down) in zip(corners, boxes, strict=True):
        drawn[y : y + down, x : x + across] += 1
    assert drawn.max() == 1
    assert drawn.sum() == boxes.prod(axis=1).sum()


def test_many_boxes_leave_little_room_unused() -> None:
    boxes = np.random.default_rng(0).integers(4, 60, (400, 2))
    _, (width, height) = packed(boxes)
    assert boxes.prod(axis=1).sum() > 0.8 * width * height
    assert 0.7 < width / height < 1.4


def test_each_pixel_knows_its_face_and_where_in_it() -> None:
    corners = np.array(
        [[[2, 2], [30, 2], [2, 22]], [[30, 2], [30, 22], [2, 22]], [[40, 1], [47, 1], [40, 9]]]
    )
    hits = faces_at(corners.astype(np.float64), 50, 25)
    covered = hits.covered
    y, x = np.nonzero(covered)
    centres = np.stack([x, y], axis=-1) + 0.5
    found = np.einsum("hk,hkd->hd", hits.barycentric(), corners[hits.face])
    np.testing.assert_allclose(found, centres, atol=1e-5)
    assert covered[2:22, 2:30].all()
    assert np.bincount(hits.face) == pytest.approx([280, 280, 28], rel=0.06)
    assert covered.sum() == len(hits.face)
    assert not covered[:, 31:40].any()


def test_it_is_what_rays_through_the_flat_faces_find() -> None:
    corners = np.random.default_rng(0).uniform(0, 40, (1, 3, 2))
    beside = corners[:, [2, 1, 0]] + [45, 0]  # the same, turned over
    both = np.concatenate([corners, beside])
    found = faces_at(both, 90, 40)
    flat = np.dstack([both, np.zeros((2, 3))]).reshape(-1, 3)
    y, x = np.mgrid[:40, :90] + 0.5
    above = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
    hits = RayCaster(flat, np.arange(6).reshape(-1, 3)).cast(above, down)
    np.testing.assert_array_equal(found.covered.ravel(), hits.hit)
    np.testing.assert_array_equal(found.face, hits.face[hits.hit])
    np.testing.assert_allclose(found.barycentric(), hits.barycentric[hits.hit], atol=1e-5)


@pytest.mark.parametrize("threads", [1, 3])
def test_however_many_threads_draw_it_is_the_same(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    corners = np.random.default_rng(0).uniform(-5, 45, (9, 3, 2))
    expected = faces_at(corners, 40, 37)
    monkeypatch.setattr("torch.get_num_threads", lambda: threads)
    found = faces_at(corners, 40, 37)
    np.testing.assert_array_equal(found.covered, expected.covered)
    np.testing.assert_array_equal(found.face, expected.face)


def test_a_face_without_area_covers_nothing() -> None:
    line = np.array([[[1.5, 1.5], [5.5, 1.5], [9.5, 1.5]]])
    assert not faces_at(line, 12, 4).covered.any()
