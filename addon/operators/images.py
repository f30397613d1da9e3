"""Step 1: the list of photographs."""

from collections.abc import Callable, Iterable
from errno import ENOENT
from os import strerror
from pathlib import Path
from typing import ClassVar

import bpy
from bpy.props import CollectionProperty, StringProperty

from ...backend.wire.photographs import SUFFIXES, passed_over, passed_over_text, photographs_in
from ..image_header import size_or_none
from ..properties import IN_BLEND, FEWVIEW_PG_settings, settings_of

MOST_IMAGES = 1000
_SMALL_PX = 640


def add_images(settings: FEWVIEW_PG_settings, paths: Iterable[Path]) -> int:
    """Put the files on the list, each once and sorted as given; how many were new."""
    known = {bpy.path.abspath(image.path) for image in settings.images}
    num_new = 0
    for path in paths:
        if str(path) in known or len(settings.images) >= MOST_IMAGES:
            continue
        known.add(str(path))
        image = settings.images.add()
        image.name, image.path = path.name, str(path)
        examine(image)
        num_new += 1
    settings.active_image = max(len(settings.images) - 1, 0)
    return num_new


def examine(image: bpy.types.PropertyGroup) -> None:
    """Fill in the size of the file and what is wrong with it."""
    path = Path(bpy.path.abspath(image.path))
    image.width, image.height = size_or_none(path) or (0, 0)
    if not path.is_file():
        image.problem = "The file is missing"
    elif 0 < max(image.width, image.height) < _SMALL_PX:
        image.problem = f"Small: fine detail needs {_SMALL_PX} pixels or more"
    else:
        image.problem = ""


def used_images(settings: FEWVIEW_PG_settings) -> tuple[Path, ...]:
    """The files that are ticked."""
    return tuple(Path(bpy.path.abspath(image.path)) for image in settings.images if image.use)


def list_problems(settings: FEWVIEW_PG_settings) -> tuple[str, ...]:
    """What the user should know of the list as a whole."""
    used = [image for image in settings.images if image.use]
    problems = []
    if len(used) == 1:
        problems.append("One photograph shows no depth: add more")
    elif len(used) == 2:
        problems.append("Two photographs are few: three or more work better")
    if len({(max(i.width, i.height), min(i.width, i.height)) for i in used if i.width}) > 1:
        problems.append("Sizes differ: cropped photographs are hard to place")
    if len(used) > 40:
        problems.append("Many photographs take long: 20 are usually enough")
    return tuple(problems)


class FEWVIEW_OT_add_images(bpy.types.Operator):
    """Add photographs to the list; without a selection, all of the folder"""

    bl_idname = "fewview.add_images"
    bl_label = "Add Photographs"
    bl_options = {"REGISTER", "UNDO"}

    filepath: StringProperty(subtype="FILE_PATH", options={"SKIP_SAVE", *IN_BLEND})
    directory: StringProperty(subtype="DIR_PATH", options={"SKIP_SAVE", *IN_BLEND})
    files: CollectionProperty(type=bpy.types.OperatorFileListElement, options={"SKIP_SAVE", "HIDDEN"})
    filter_glob: StringProperty(default=";".join(f"*{e}" for e in SUFFIXES), options={"HIDDEN"})

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> set[str]:
        """Open the file browser, unless files were dropped."""
        if self.directory and self.files:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Add what was chosen."""
        try:
            paths, left_out = self._paths()
        except FileNotFoundError as error:
            self.report({"ERROR"}, f"{error.filename} is not there: choose another file or folder")
            return {"CANCELLED"}
        except OSError as error:
            self.report({"ERROR"}, f"The folder cannot be read: {error.strerror or error}")
            return {"CANCELLED"}
        skipped = passed_over_text(left_out)
        if not paths:
            self.report({"ERROR"}, skipped or f"There are no images ({', '.join(SUFFIXES)}): choose others")
            return {"CANCELLED"}
        if skipped:
            self.report({"WARNING"}, skipped)
        settings = settings_of(context)
        num_new = add_images(settings, paths)
        settings.source = "FILES"
        if len(settings.images) >= MOST_IMAGES:
            self.report({"WARNING"}, f"The list is full: it takes {MOST_IMAGES} photographs")
        self.report({"INFO"}, f"{num_new} {'photograph' if num_new == 1 else 'photographs'} added")
        return {"FINISHED"}

    def _paths(self) -> tuple[list[Path], tuple[str, ...]]:
        """The photographs that are meant, and the names of pictures that are none.

        Raises OSError where one, or the folder, cannot be read.
        """
        if not self.directory and not self.filepath:
            return [], ()  # not the folder that Blender was started in
        folder = Path(bpy.path.abspath(self.directory)) if self.directory else None
        names = [file.name for file in self.files if file.name]
        if folder is not None and names:
            chosen = [folder / name for name in names]
        elif self.filepath and Path(bpy.path.abspath(self.filepath)).is_file():
            chosen = [Path(bpy.path.abspath(self.filepath))]
        else:
            chosen = [folder or Path(bpy.path.abspath(self.filepath))]
        found: list[Path] = []
        for path in chosen:
            if not path.exists():
                raise FileNotFoundError(ENOENT, strerror(ENOENT), str(path))
            found += sorted(photographs_in(path)) if path.is_dir() else [path]
        return [path.absolute() for path in found if path.suffix.lower() in SUFFIXES], passed_over(chosen)


class _OnList:
    """Mix-in of the operators that need a list with something on it."""

    poll_message_set: ClassVar[Callable[[str], None]]

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        if not settings_of(context).images:
            cls.poll_message_set("Add photographs first")
            return False
        return True


class FEWVIEW_OT_remove_image(_OnList, bpy.types.Operator):
    """Take the active photograph off the list; the file stays"""

    bl_idname = "fewview.remove_image"
    bl_label = "Remove Photograph"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove one."""
        settings = settings_of(context)
        settings.images.remove(min(max(settings.active_image, 0), len(settings.images) - 1))
        settings.active_image = max(min(settings.active_image, len(settings.images) - 1), 0)
        return {"FINISHED"}


class FEWVIEW_OT_clear_images(_OnList, bpy.types.Operator):
    """Take all photographs off the list, and cameras and true mesh that lie beside them; the files stay"""

    bl_idname = "fewview.clear_images"
    bl_label = "Clear List"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Remove all, and what is of use for these alone."""
        settings = settings_of(context)
        beside = {Path(bpy.path.abspath(image.path)).parent.parent for image in settings.images}
        if Path(bpy.path.abspath(settings.cameras_path)).parent in beside:
            settings.camera_source, settings.cameras_path = "ESTIMATE", ""
        if Path(bpy.path.abspath(settings.truth)).parent in beside:
            settings.truth = ""
        settings.images.clear()
        return {"FINISHED"}


class FEWVIEW_FH_images(bpy.types.FileHandler):
    """Photographs dropped on the sidebar's FewView tab"""

    bl_idname = "FEWVIEW_FH_images"
    bl_label = "FewView Photographs"
    bl_import_operator = "fewview.add_images"
    bl_file_extensions = ";".join(SUFFIXES)

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Only there: elsewhere a dropped image means what it always means."""
        area, region = context.area, context.region
        if area is None or region is None or area.type != "VIEW_3D" or region.type != "UI":
            return False
        return getattr(region, "active_panel_category", "FewView") == "FewView"


CLASSES = (FEWVIEW_OT_add_images, FEWVIEW_OT_remove_image, FEWVIEW_OT_clear_images, FEWVIEW_FH_images)
