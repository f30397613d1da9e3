"""Takes the pictures of the add-on in docs/images: goes through all steps in a real Blender with a window.

    blender --factory-startup --python docs/take_screenshots.py -- --output docs/images

The extension must be installed and the environment variable FEWVIEW_PYTHON name a Python with the backend.
The pictures are of the sidebar alone, and two of the viewport with the result. Takes about two minutes.
"""

import argparse
import importlib
import os
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator
from pathlib import Path

import bpy
import numpy as np
from mathutils import Euler
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from addon.true_mesh import bounding_sphere, true_mesh
from blender_scenes.lighting import light_scene
from blender_scenes.reconstruct_scene import enable_extension
from blender_scenes.scenes import SCENES, build_scene

VIEW_ANGLES = (1.25, 0.0, -0.55)
"""From the front, a little from the left and above."""
SETTLE_S = 0.7
"""Until what was changed is on the screen; drawing is slow where there is no GPU."""


def tour(output: Path) -> Iterator[float]:
    """Every state in turn; yields how many seconds to wait."""
    python = os.environ.pop("FEWVIEW_PYTHON", "")
    enable_extension()
    settings = bpy.context.scene.fewview
    yield from opened_sidebar()
    yield from photographed(output / "panel_setup.png")

    os.environ["FEWVIEW_PYTHON"] = python
    bpy.ops.fewview.check_backend()
    yield from until_idle()
    yield from photographed(output / "panel_start.png")

    target = subject()
    settings.source = "RENDER"
    settings.output = tempfile.mkdtemp(prefix="fewview-tour-")
    bpy.ops.fewview.generate_views(target=target.name, arrangement="ARC", view_count=6)
    yield from photographed(output / "panel_render.png")
    yield from photographed(output / "views.jpg", whole=True)
    bpy.ops.fewview.render_views(samples=16)
    yield 6.0
    yield from photographed(output / "panel_rendering.png")
    yield from until_idle()

    settings.source = "FILES"
    yield from photographed(output / "panel_images.png")
    bpy.ops.fewview.estimate_cameras()
    yield from until_idle()
    bpy.ops.fewview.add_region()
    yield from photographed(output / "panel_cameras.png")
    bpy.ops.fewview.remove_region()
    target.hide_set(True)
    bpy.ops.fewview.reconstruct()
    yield 12.0
    yield from photographed(output / "panel_running.png")
    yield from until_idle()
    yield from photographed(output / "panel_result.png")
    yield from photographed(output / "result_colour.jpg", whole=True)
    bpy.ops.fewview.show_support()
    yield from photographed(output / "result_support.jpg", whole=True)

    # Something to fail on.
    settings.images[0].path = str(Path(tempfile.gettempdir()) / "photographs" / "not_there.png")
    bpy.ops.fewview.reconstruct()
    yield from until_idle()
    yield from photographed(output / "panel_failed.png")


def subject() -> bpy.types.Object:
    """The monkey of the demo, in its light."""
    for made in list(bpy.context.scene.objects):
        bpy.data.objects.remove(made)
    built = build_scene(SCENES["monkey"]("monkey", 0))
    centre, radius = bounding_sphere(true_mesh(built.subjects))
    light_scene(centre=centre, radius=radius)
    for made in bpy.context.scene.objects:
        made.hide_set(made.type == "LIGHT")  # it still shines
    bpy.context.view_layer.objects.active = built.subjects[0]
    return built.subjects[0]


def opened_sidebar() -> Iterator[float]:
    """The sidebar with FewView's tab in front, wide enough to read."""
    area = view()
    area.spaces.active.show_region_ui = True
    area.spaces.active.shading.type = "SOLID"
    yield 1.0
    region = next(region for region in area.regions if region.type == "UI")
    region.active_panel_category = "FewView"
    yield SETTLE_S


def photographed(path: Path, *, whole: bool = False) -> Iterator[float]:
    """Write the sidebar, or the whole viewport with what is selected in its middle."""
    area = view()
    sidebar = next(region for region in area.regions if region.type == "UI")
    if whole:
        selected = bool(bpy.context.selected_objects)
        main_region = next(region for region in area.regions if region.type == "WINDOW")
        area.spaces.active.region_3d.view_rotation = Euler(VIEW_ANGLES).to_quaternion()
        with bpy.context.temp_override(window=window(), area=area, region=main_region):
            (bpy.ops.view3d.view_selected if selected else bpy.ops.view3d.view_all)()
    area.tag_redraw()
    yield SETTLE_S
    shown = area if whole else sidebar
    picture = window_picture()[shown.y : shown.y + shown.height, shown.x : shown.x + shown.width]
    write_picture(path, picture if whole else without_empty_rows(picture))
    sys.stderr.write(f"{path}\n")


def window_picture() -> NDArray[np.float32]:
    """(height, width, 4): what is in the window, bottom row first."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "window.png"
        with bpy.context.temp_override(window=window()):
            bpy.ops.screen.screenshot(filepath=str(path))
        picture = read_png(path)
        if not picture[..., :3].any():  # a screen drawn in software: the X server knows better
            subprocess.run(["import", "-window", "root", str(path)], check=True)
            picture = read_png(path)
    return picture


def without_empty_rows(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Without the part at the bottom where no panel is."""
    same = np.ptp(picture[:, :-20, :3], axis=1).max(axis=-1) < 0.02  # the scroll bar is on the right
    first = int(np.argmin(same))
    return picture[max(first - 12, 0) :]


def read_png(path: Path) -> NDArray[np.float32]:
    """(height, width, 4), bottom row first."""
    image = bpy.data.images.load(str(path))
    width, height = image.size
    pixels = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(pixels)
    bpy.data.images.remove(image)
    return pixels.reshape(height, width, 4)


def write_picture(path: Path, picture: NDArray[np.float32]) -> None:
    """A PNG, or a JPEG where the name says so, of (height, width, 4), bottom row first."""
    made = bpy.data.images.new("picture", picture.shape[1], picture.shape[0])
    made.pixels.foreach_set(np.ascontiguousarray(picture).ravel())
    made.filepath_raw = str(path)
    made.file_format = "JPEG" if path.suffix == ".jpg" else "PNG"
    made.save(quality=85)
    bpy.data.images.remove(made)


def window() -> bpy.types.Window:
    """Blender's window."""
    return bpy.context.window_manager.windows[0]


def until_idle() -> Iterator[float]:
    """Wait for the running job."""
    jobs = importlib.import_module(f"{extension_name()}.addon.jobs")
    while jobs.running() is not None:
        yield 0.2
    end = jobs.ended()
    how = "fine" if end.failure is None else end.failure.text
    longest_ms = 1000 * jobs.longest_tick_s
    sys.stderr.write(f"{end.title}: {how}, {end.seconds:.0f} s, longest tick {longest_ms:.1f} ms\n")
    yield SETTLE_S


def extension_name() -> str:
    """The module Blender knows the add-on by."""
    return next(name for name in bpy.context.preferences.addons.keys() if name.endswith(".fewview"))  # noqa: SIM118


def view() -> bpy.types.Area:
    """The 3D viewport."""
    return next(area for area in window().screen.areas if area.type == "VIEW_3D")


def main(words: list[str]) -> None:
    """Start the tour once the window is there; Blender quits at its end, with code 1 where it failed."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--output", type=Path, required=True)
    output = parser.parse_args(words).output.absolute()
    output.mkdir(parents=True, exist_ok=True)
    bpy.context.preferences.view.show_splash = False
    steps = tour(output)

    def step() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            bpy.ops.wm.quit_blender()
        except Exception:  # noqa: BLE001 - a timer would drop it in silence
            traceback.print_exc()
            sys.stderr.flush()
            os._exit(1)
        return None

    bpy.app.timers.register(step, first_interval=2.0, persistent=True)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1 :])
