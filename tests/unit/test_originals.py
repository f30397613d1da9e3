"""Colours read from a photograph's own file: through its lens, at more pixels than the view has."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from backend.errors import ErrorCode, ReconstructionError
from backend.maths.atlas import faces_at
from backend.maths.raycast import interpolate
from backend.maths.sampling import colours_at
from backend.scene import Camera, Lens, SurfaceMesh, View
from backend.stages.cameras.lenses import colmap_lens
from backend.stages.mesh.originals import Original, close_up, close_up_camera
from backend.stages.mesh.texture import TextureConfig, paint

WIDTH, HEIGHT, FOCAL_PX = 600, 400, 520.0
DISTANCE = 2.0
BENT = (0.12, -0.05, 0.003, -0.002)


def wall_srgb(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fine stripes on the plane z = DISTANCE, as wide as five pixels of the file."""
    wave = 2 * np.pi * FOCAL_PX / (5 * DISTANCE)
    return 0.5 + 0.3 * np.stack([np.cos(wave * x), np.cos(wave * y), np.cos(0.1 * wave * (x + y))], axis=-1)


def lens_of(model: str) -> Lens:
    pinhole = (FOCAL_PX, FOCAL_PX, WIDTH / 2 + 3, HEIGHT / 2 - 5)
    return Lens(
        model=model, width=WIDTH, height=HEIGHT, params=pinhole if model == "PINHOLE" else (*pinhole, *BENT)
    )


def photographed(path: Path, lens: Lens) -> Original:
    """The wall through the lens, supersampled so that a pixel is a mean."""
    fine = (np.arange(4) + 0.5) / 4
    y, x = (np.arange(HEIGHT)[:, None] + fine).ravel(), (np.arange(WIDTH)[:, None] + fine).ravel()
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = colmap_lens(lens).cam_from_img(pixels)
    colours = wall_srgb(*(DISTANCE * rays).T).reshape(HEIGHT, 4, WIDTH, 4, 3).mean(axis=(1, 3))
    Image.fromarray(np.round(255 * colours).astype(np.uint8)).save(path)
    return Original(path=path, lens=lens)


def small_view(camera_from_world: np.ndarray | None = None, mask: np.ndarray | None = None) -> View:
    """A quarter of the size; grey, so that its own colours are known from the file's."""
    camera = Camera(
        camera_from_world=np.eye(4) if camera_from_world is None else camera_from_world,
        fx_px=FOCAL_PX / 4,
        fy_px=FOCAL_PX / 4,
        cx_px=(WIDTH / 2 + 3) / 4,
        cy_px=(HEIGHT / 2 - 5) / 4,
        width=WIDTH // 4,
        height=HEIGHT // 4,
    )
    grey = np.full((camera.height, camera.width, 3), 0.5, np.float32)
    return View(name="wall.png", camera=camera, image_srgb=grey, mask=mask)


def places() -> np.ndarray:
    flat = np.random.default_rng(0).uniform([-0.8, -0.5], [0.8, 0.5], (400, 2))
    return np.column_stack([flat, np.full(400, DISTANCE)])


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_places_are_found_through_the_lens(tmp_path: Path, model: str) -> None:
    read = close_up(small_view(), photographed(tmp_path / "wall.png", lens_of(model)), 2048)
    found = read(places())
    # a pixel and then a bilinear mean take a fifth of stripes of five pixels
    assert np.abs(found[:, :3] - wall_srgb(*places()[:, :2].T)).max() < 0.12
    np.testing.assert_array_equal(found[:, 3], 1.0)


def test_the_view_says_where_the_photograph_was_taken(tmp_path: Path) -> None:
    """Cameras may have been refined since; the lens has not."""
    moved = np.eye(4)
    moved[0, 3] = 0.01  # 2.6 pixels of the file: half a stripe
    corners = np.array([[-0.8, -0.5], [0.8, -0.5], [0.8, 0.5], [-0.8, 0.5]])
    wall = SurfaceMesh(
        vertices=np.column_stack([corners, np.full(4, DISTANCE)]) - [0.01, 0, 0],
        faces=np.array([[0, 2, 1], [0, 3, 2]]),
        normals=np.tile(np.float32([0, 0, -1]), (4, 1)),
        colours_srgb=np.zeros((4, 3), np.uint8),
        support=np.ones(4, np.float32),
    )
    views, original = (small_view(moved),), photographed(tmp_path / "wall.png", lens_of("PINHOLE"))
    seen, alike = np.ones((4, 1), bool), np.zeros((1, 3))
    texture, _ = paint(wall, seen, views, (original,), alike, TextureConfig())
    texels = faces_at(texture.corners_px, *texture.image_srgb.shape[1::-1])
    places = interpolate(wall.vertices, wall.faces[texels.face], texels.barycentric())
    expected = wall_srgb(places[:, 0] + 0.01, places[:, 1])
    assert np.abs(texture.image_srgb[texels.covered] / 255 - expected).max() < 0.12


def test_the_file_is_read_at_the_size_that_is_asked_for(tmp_path: Path) -> None:
    original = photographed(tmp_path / "wall.png", lens_of("PINHOLE"))
    camera = close_up_camera(small_view(), original, 300)
    assert (camera.width, camera.height) == (300, 200)
    assert camera.fx_px == pytest.approx(FOCAL_PX / 2)
    half = close_up(small_view(), original, 300)(places())[:, :3]
    whole = close_up(small_view(), original, 2048)(places())[:, :3]
    assert half[:, 0].std() < 0.7 * whole[:, 0].std()  # stripes of two and a half pixels
    np.testing.assert_allclose(half[:, 2], whole[:, 2], atol=0.03)


def test_a_file_that_is_no_larger_is_not_read_again() -> None:
    view, nowhere = small_view(), Original(path=Path("gone.png"), lens=lens_of("PINHOLE"))
    assert close_up_camera(view, nowhere, WIDTH // 4) is view.camera
    np.testing.assert_array_equal(close_up(view, nowhere, WIDTH // 4)(places()), colours_at(view, places()))
    np.testing.assert_array_equal(close_up(view, None, 2048)(places()), colours_at(view, places()))
    with pytest.raises(ReconstructionError) as caught:
        close_up(view, nowhere, 2048)
    assert caught.value.code == ErrorCode.PHOTO_UNREADABLE


def test_the_mask_is_the_view_s(tmp_path: Path) -> None:
    mask = np.zeros((HEIGHT // 4, WIDTH // 4), np.float32)
    mask[:, : WIDTH // 8] = 1
    original = photographed(tmp_path / "wall.png", lens_of("OPENCV"))
    found = close_up(small_view(mask=mask), original, 2048)(places())
    np.testing.assert_array_equal(found[:, 3], colours_at(small_view(mask=mask), places())[:, 3])
    assert 0.3 < found[:, 3].mean() < 0.7
