"""Cut-outs: what agrees is kept, what contradicts the others is not, and the network is fetched once."""

import http.server
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest

from backend.errors import Cancelled, ErrorCode, ReconstructionError
from backend.scene import Mask, SolvedCameras, View, no_progress
from backend.stages.cutout import cutting_out, network
from backend.stages.cutout.consensus import agreed
from backend.stages.cutout.cutting_out import cut_out, with_cut_out
from tests.brightness_network import brightness_network
from tests.synthetic_scene import Scene, arc_cameras, photographed, ring_cameras, surface_points

NO_POINTS = np.zeros((0, 3))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return photographed(ring_cameras(6, 160))


@pytest.fixture(scope="module")
def points() -> np.ndarray:
    """On the body, on all its sides."""
    directions = np.random.default_rng(0).normal(size=(400, 3))
    return surface_points(directions / np.linalg.norm(directions, axis=1, keepdims=True))


def masks_of(scene: Scene) -> list[Mask | None]:
    return [None if view.mask is None else view.mask.copy() for view in scene.views]


def bare(scene: Scene) -> tuple[View, ...]:
    return scene.without_masks().views


def is_none(masks: list[Mask | None]) -> bool:
    return all(mask is None for mask in masks)


# what is held against each other


def test_true_masks_stay_as_they_are(scene: Scene, points: np.ndarray) -> None:
    found = agreed(masks_of(scene), bare(scene), points)
    for mask, true in zip(found, masks_of(scene), strict=True):
        np.testing.assert_array_equal(mask, true)


def test_what_one_alone_shows_beside_the_subject_is_taken_off(scene: Scene, points: np.ndarray) -> None:
    masks = masks_of(scene)
    masks[2][:20, :30] = 1  # type: ignore[index]
    found = agreed(masks, bare(scene), points)
    for mask, true in zip(found, masks_of(scene), strict=True):
        np.testing.assert_array_equal(mask, true)


def test_a_mask_that_lacks_a_part_is_not_used(scene: Scene, points: np.ndarray) -> None:
    masks, true = masks_of(scene), masks_of(scene)
    columns = np.flatnonzero(masks[4].any(axis=0))  # type: ignore[union-attr]
    masks[4][:, columns[0] : columns[len(columns) // 3]] = 0  # type: ignore[index]
    found = agreed(masks, bare(scene), points)
    assert found[4] is None
    for index in (0, 1, 2, 3, 5):
        np.testing.assert_array_equal(found[index], true[index])


def test_without_points_space_tells_of_a_part_that_is_lacking() -> None:
    """The others would leave it empty with this one."""
    arc = photographed(arc_cameras(4, 75, 160))
    masks, true = masks_of(arc), masks_of(arc)
    masks[1][:, 80:] = 0  # type: ignore[index]
    found = agreed(masks, bare(arc), NO_POINTS)
    assert found[1] is None
    for index in (0, 2, 3):
        np.testing.assert_array_equal(found[index], true[index])


def test_points_tell_of_a_part_too_small_for_space(scene: Scene, points: np.ndarray) -> None:
    masks = masks_of(scene)
    rows = np.flatnonzero(masks[4].any(axis=1))  # type: ignore[union-attr]
    masks[4][rows[len(rows) // 2] :][:12] = 0  # type: ignore[index]
    assert agreed(masks, bare(scene), points)[4] is None


def test_where_each_shows_something_else_none_is_used(scene: Scene, points: np.ndarray) -> None:
    corner = np.zeros((120, 160), np.float32)
    corner[10:50, 10:50] = 1
    masks: list[Mask | None] = [np.roll(corner, (30 * index, 50 * index), (0, 1)) for index in range(6)]
    assert is_none(agreed(masks, bare(scene), points))


def test_where_less_than_half_show_it_none_is_used(scene: Scene, points: np.ndarray) -> None:
    masks = masks_of(scene)
    for mask in masks[2:]:
        mask[:] = 0  # type: ignore[index]
    assert is_none(agreed(masks, bare(scene), points))
    assert is_none(agreed([masks[0], *[None] * 5], bare(scene), points))


def test_a_mask_of_the_user_stands(scene: Scene, points: np.ndarray) -> None:
    """It is not given again, and is used though it lacks a part."""
    cut = masks_of(scene)[0]
    assert cut is not None
    columns = np.flatnonzero(cut.any(axis=0))
    cut[:, columns[0] : columns[len(columns) // 3]] = 0
    views = (replace(scene.views[0], mask=cut), *bare(scene)[1:])
    found = agreed([cut, *masks_of(scene)[1:]], views, points)
    assert found[0] is None
    assert all(mask is not None for mask in found[1:])


def test_masks_of_the_user_count_as_agreeing(scene: Scene, points: np.ndarray) -> None:
    """Though a side of each is missing, for which they would not be used if they were cut-outs."""
    masks = masks_of(scene)
    for mask in masks[:4]:
        assert mask is not None
        mask[:, np.flatnonzero(mask.any(axis=0))[:14]] = 0
    assert is_none(agreed(masks, bare(scene), points))
    held = [replace(view, mask=mask) for view, mask in zip(scene.views[:4], masks, strict=False)]
    found = agreed(masks, (*held, *bare(scene)[4:]), points)
    assert [mask is None for mask in found] == [True] * 4 + [False] * 2


def test_what_contradicts_masks_of_the_user_is_not_used() -> None:
    arc = photographed(arc_cameras(4, 75, 160))
    masks = masks_of(arc)
    masks[1][:, 80:] = 0  # type: ignore[index]
    views = (bare(arc)[0], replace(arc.views[1], mask=masks[1]), *bare(arc)[2:])
    found = agreed(masks, views, NO_POINTS)
    assert found[0] is None or found[2] is None


# the stage


class Seer:
    """A network that knows the truth, by the photographs' order."""

    def __init__(self, masks: list[Mask | None]) -> None:
        self.left = list(masks)


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch, scene: Scene) -> list[Mask | None]:
    """The masks that the network will tell, one photograph after the other."""
    masks = masks_of(scene)
    monkeypatch.setattr(cutting_out, "load_network", lambda _progress: Seer(masks))
    monkeypatch.setattr(cutting_out, "shown_subject", lambda seer, _image: seer.left.pop(0))
    return masks


def solved_of(scene: Scene, points: np.ndarray) -> SolvedCameras:
    return scene.without_masks().solved(points)


def test_the_subject_is_cut_out_of_all(seen: list[Mask | None], scene: Scene, points: np.ndarray) -> None:
    solved = solved_of(scene, points)
    told: list[float] = []
    cut = cut_out(solved, progress=lambda share, _text: told.append(share))
    assert told == sorted(told)
    assert cut.doubt is None
    views = with_cut_out(solved, cut).views
    for view, true in zip(views, scene.views, strict=True):
        np.testing.assert_array_equal(view.mask, true.mask)
    (decision,) = cut.decisions
    assert decision.choice == "the subject, in 6 of 6 photographs"
    assert with_cut_out(solved, cut).decisions[-1] is decision


def test_where_it_is_not_the_user_is_told(seen: list[Mask | None], scene: Scene, points: np.ndarray) -> None:
    seen[4][:] = 0  # type: ignore[index]
    cut = cut_out(solved_of(scene, points), progress=no_progress)
    assert cut.masks[4] is None
    assert cut.doubt is not None
    assert scene.views[4].name in cut.doubt
    assert cut.decisions[0].choice == "the subject, in 5 of 6 photographs"


def test_where_it_is_nowhere_the_user_is_told(
    seen: list[Mask | None], scene: Scene, points: np.ndarray
) -> None:
    for mask in seen:
        mask[:] = 0  # type: ignore[index]
    cut = cut_out(solved_of(scene, points), progress=no_progress)
    assert cut.masks == (None,) * 6
    assert cut.doubt is not None
    assert "The subject was not cut out" in cut.doubt


def test_where_all_have_masks_no_network_is_needed(
    monkeypatch: pytest.MonkeyPatch, scene: Scene, points: np.ndarray
) -> None:
    monkeypatch.setattr(cutting_out, "load_network", lambda _progress: pytest.fail("not needed"))
    solved = scene.solved(points)
    cut = cut_out(solved, progress=no_progress)
    assert (cut.masks, cut.doubt) == ((None,) * 6, None)
    assert with_cut_out(solved, cut).views == solved.views


# the network


@pytest.fixture
def brightness_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "brightness.onnx"
    path.write_bytes(brightness_network())
    monkeypatch.setenv("FEWVIEW_CUT_OUT_NETWORK", str(path))
    return path


def test_a_network_sees_the_photograph_and_its_answer_has_its_size(brightness_file: Path) -> None:
    """Run by onnxruntime: this one gives the mean of the channels it gets, which are a half too dark."""
    loaded = network.load_network(no_progress)
    image = np.full((30, 50, 3), 0.25, np.float32)
    image[:, 25:] = (0.8, 0.9, 1.0)
    share = network.shown_subject(loaded, image)
    assert share.shape == (30, 50)
    assert share.dtype == np.float32
    np.testing.assert_array_equal(share[:, :20], 0)  # what is below black is black
    np.testing.assert_allclose(share[:, 30:], 0.4, atol=1e-6)


def test_a_file_that_is_no_network_is_told_of(brightness_file: Path) -> None:
    brightness_file.write_bytes(b"<html>not found</html>")
    with pytest.raises(ReconstructionError, match=r"brightness\.onnx .*cannot be used") as raised:
        network.load_network(no_progress)
    assert raised.value.code == ErrorCode.NETWORK_UNAVAILABLE


class _Served(http.server.BaseHTTPRequestHandler):
    answers: list[bytes]

    def do_GET(self) -> None:
        body = self.answers.pop(0)
        self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[list[bytes]]:
    """What a server answers, one request after the other; what is fetched is kept in an empty folder."""
    monkeypatch.delenv("FEWVIEW_CUT_OUT_NETWORK", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"):
        monkeypatch.delenv(name, raising=False)
    waiting: list[bytes] = []
    handler = type("Served", (_Served,), {"answers": waiting})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        monkeypatch.setattr(network, "_ADDRESS", f"http://127.0.0.1:{server.server_port}/network.onnx")
        yield waiting
        server.shutdown()
        thread.join()


def md5(of: bytes) -> str:
    import hashlib

    return hashlib.md5(of, usedforsecurity=False).hexdigest()


def test_it_is_fetched_once_with_a_word_of_how_far(
    answers: list[bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    content = brightness_network()
    monkeypatch.setattr(network, "_MD5", md5(content))
    answers.append(content)
    told: list[tuple[float, str]] = []
    assert isinstance(
        network.load_network(lambda share, text: told.append((share, text))), onnxruntime.InferenceSession
    )
    assert told[-1] == (1.0, "fetching the network, this once: 0 of 0 MB")
    assert not answers
    network.load_network(no_progress)  # nothing is asked for again
    assert [path.read_bytes() for path in tmp_path.rglob("*.onnx")] == [content]


def test_what_comes_damaged_is_not_kept(answers: list[bytes], tmp_path: Path) -> None:
    answers.append(b"something else")
    with pytest.raises(ReconstructionError, match="could not be fetched") as raised:
        network.load_network(no_progress)
    assert raised.value.code == ErrorCode.NETWORK_UNAVAILABLE
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


def test_without_a_connection_the_remedy_names_file_and_folder(
    answers: list[bytes], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(network, "_ADDRESS", "http://127.0.0.1:9/network.onnx")
    with pytest.raises(ReconstructionError, match="no connection") as raised:
        network.load_network(no_progress)
    assert "http://127.0.0.1:9/network.onnx into the folder" in raised.value.remedy
    assert str(tmp_path) in raised.value.remedy


def test_where_that_is_not_allowed_nothing_is_fetched_but_what_is_there_is_used(
    answers: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    content = brightness_network()
    monkeypatch.setattr(network, "_MD5", md5(content))
    answers.append(content)
    monkeypatch.setenv("FEWVIEW_OFFLINE", "1")
    with pytest.raises(ReconstructionError, match="not allowed to go online") as raised:
        network.load_network(no_progress)
    assert "Allow Online Access" in raised.value.remedy
    assert answers == [content]
    monkeypatch.delenv("FEWVIEW_OFFLINE")
    network.load_network(no_progress)
    monkeypatch.setenv("FEWVIEW_OFFLINE", "1")
    network.load_network(no_progress)


def test_fetching_can_be_cancelled_and_leaves_nothing(answers: list[bytes], tmp_path: Path) -> None:
    answers.append(bytes(200_000))

    def stop(_share: float, _text: str) -> None:
        raise Cancelled

    with pytest.raises(Cancelled):
        network.load_network(stop)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
