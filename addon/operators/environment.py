"""Check, install and remove the Python that reconstructs."""

import os
import sys
from pathlib import Path

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty

from ... import __package__ as EXTENSION
from ...backend.wire.environment import python_in
from .. import environment, jobs
from ..environment import PythonMissing, State
from ..preferences import preferences_of

_ONLINE = "Allow Online Access in Preferences > System first, or Set Up by Hand"
_BUSY = "Wait until the running job ends, or cancel it"
_BUILDS = [
    ("PREFERENCES", "As in the Preferences", "The build that is chosen there"),
    ("cpu", "CPU", "The smallest download; no GPU is needed"),
    ("default", "Standard", "The usual build; on Linux with CUDA, on a Mac with MPS"),
    ("cuda", "CUDA", "For a GPU by NVIDIA; the largest download"),
]


def backend_python_or_reason(context: bpy.types.Context) -> tuple[Path | None, str]:
    """The Python that reconstructs; where there is none, or it failed its check, what to do about it.

    One that was not checked yet is taken: a job in it says what is missing.
    """
    try:
        found = _found(context)
    except PythonMissing as error:
        return None, str(error)
    if found is None:
        return None, "FewView is not set up: press Set Up FewView, or choose a Python in the preferences"
    known = environment.readiness(found.path)
    if known.state is State.NOT_READY:
        return (
            None,
            f"FewView is not set up ({known.text}): press Set Up FewView, or Check Setup if that has changed",
        )
    return found.path, ""


def reason_against_a_job(context: bpy.types.Context) -> str:
    """Why none can be started now; empty where one can."""
    job = jobs.running()
    return f"{job.title} is still running" if job else backend_python_or_reason(context)[1]


def backend_state(context: bpy.types.Context) -> tuple[State, str]:
    """What is known of the backend, for the panel: a state and a line."""
    try:
        found = _found(context)
    except PythonMissing as error:
        return State.NOT_READY, str(error)
    if found is None:
        return State.NOT_READY, "Not set up yet"
    known = environment.readiness(found.path)
    return known.state, known.text


def managed_folder(context: bpy.types.Context) -> Path:
    """Where the managed environment is, or would be made."""
    chosen = preferences_of(context).environment_folder
    if chosen:
        return environment.managed_folder(Path(bpy.path.abspath(chosen)).expanduser())
    return environment.managed_folder(environment.short_folder(os.environ) or user_folder())


def user_folder(name: str = "", *, create: bool = False) -> Path:
    """The folder that Blender keeps for this extension's files, or one inside; never the code's own."""
    try:
        return Path(bpy.utils.extension_path_user(EXTENSION, path=name, create=create))
    except ValueError:  # not installed as an extension
        return Path(bpy.utils.user_resource("DATAFILES", path=str(Path("fewview") / name), create=create))


class FEWVIEW_OT_check_backend(bpy.types.Operator):
    """Check that FewView's Python has all that a reconstruction needs"""

    bl_idname = "fewview.check_backend"
    bl_label = "Check Setup"

    python: StringProperty(
        name="Python",
        description="Python to check; the one that reconstructs where this is empty",
        subtype="FILE_PATH",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Not while a job runs."""
        return _is_free(cls)

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the check."""
        try:
            found = environment.find_python(
                variable="" if self.python else environment.chosen_text(os.environ),
                preference=self.python or _preferred(context),
                managed=managed_folder(context),
            )
        except PythonMissing as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        if found is None:
            self.report(
                {"ERROR"},
                "FewView is not set up: press Set Up FewView, or choose a Python in the preferences",
            )
            return {"CANCELLED"}
        command = environment.doctor_command(found.path)
        return _run(self, "Checking the setup", command, python=found.path)


class FEWVIEW_OT_install_backend(bpy.types.Operator):
    """Make a Python of its own for FewView, with torch and all else that a reconstruction needs"""

    bl_idname = "fewview.install_backend"
    bl_label = "Set Up FewView"

    build: EnumProperty(name="Compute On", items=_BUILDS, options={"SKIP_SAVE"})
    folder: StringProperty(
        name="Folder",
        description="Where the environment is made; the one of the preferences where this is empty",
        subtype="DIR_PATH",
        options={"SKIP_SAVE"},
    )
    again: BoolProperty(
        name="Make Anew",
        description="Replace an environment that is ready, once the new one is",
        options={"SKIP_SAVE"},
    )

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where downloads are allowed, and not while a job runs."""
        if not bpy.app.online_access:
            cls.poll_message_set(_ONLINE)
            return False
        return _is_free(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        self.build = preferences_of(context).torch_build
        return context.window_manager.invoke_props_dialog(
            self, width=450, title="Set Up FewView", confirm_text="Set Up"
        )

    def draw(self, context: bpy.types.Context) -> None:
        """What is about to happen."""
        layout = self.layout
        layout.use_property_split = True
        column = layout.column(align=True)
        column.label(text=environment.size_text(self._build(context)), icon="IMPORT")
        column.label(text=str(self._folder(context)), icon="FILE_FOLDER", translate=False)
        if self._folder(context).is_relative_to(user_folder()):
            column.label(text="Goes when the extension is removed; the preferences can name another folder")
        else:
            column.label(text="Stays when the extension is removed: press Remove Setup before that")
        layout.prop(self, "build")
        if environment.can_be_removed(self._folder(context)):
            layout.prop(self, "again")
        if environment.chosen_text(os.environ):
            layout.label(text=f"{environment.VARIABLE} is set and stays in use", icon="INFO")
        elif _preferred(context):
            layout.label(text="The Python of the preferences stays in use", icon="INFO")

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the installation."""
        folder = self._folder(context)
        command = environment.install_command(
            sys.executable, folder, build=self._build(context), again=self.again
        )
        return _run(self, "Setting up FewView", command, python=python_in(folder), folder=folder)

    def _build(self, context: bpy.types.Context) -> str:
        return preferences_of(context).torch_build if self.build == "PREFERENCES" else self.build

    def _folder(self, context: bpy.types.Context) -> Path:
        if not self.folder:
            return managed_folder(context)
        return Path(bpy.path.abspath(self.folder)).expanduser().absolute()


class FEWVIEW_OT_remove_backend(bpy.types.Operator):
    """Remove the Python that Set Up FewView made"""

    bl_idname = "fewview.remove_backend"
    bl_label = "Remove Setup"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Only where there is one that the add-on made."""
        if not environment.can_be_removed(managed_folder(context)):
            cls.poll_message_set("There is no environment that the add-on made")
            return False
        return _is_free(cls)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> set[str]:
        """Ask first."""
        return context.window_manager.invoke_confirm(
            self,
            event,
            title="Remove Setup",
            message=str(managed_folder(context)),
            confirm_text="Remove",
            icon="WARNING",
        )

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Start the removal, which takes a while: there are many files."""
        folder = managed_folder(context)
        command = environment.remove_command(sys.executable, folder)
        return _run(self, "Removing the setup", command, folder=folder)


class FEWVIEW_OT_copy_install_lines(bpy.types.Operator):
    """Copy two lines for a shell that make the environment by hand"""

    bl_idname = "fewview.copy_install_lines"
    bl_label = "Set Up by Hand"

    def execute(self, context: bpy.types.Context) -> set[str]:
        """Put them on the clipboard."""
        folder = Path.home() / "fewview-environment"
        try:
            lines = environment.hand_lines(folder)
        except OSError as error:
            self.report({"ERROR"}, f"The extension is incomplete, install it again ({error})")
            return {"CANCELLED"}
        context.window_manager.clipboard = lines
        self.report(
            {"INFO"},
            f"Copied. Run them in {environment.shell_name()}, where Python {environment.HAND_VERSION} "
            f"must be installed; then choose {python_in(folder)} as Python in the preferences",
        )
        return {"FINISHED"}


CLASSES = (
    FEWVIEW_OT_check_backend,
    FEWVIEW_OT_install_backend,
    FEWVIEW_OT_remove_backend,
    FEWVIEW_OT_copy_install_lines,
)


def _preferred(context: bpy.types.Context) -> str:
    """The Python of the preferences; empty where none is chosen."""
    chosen = preferences_of(context).backend_python
    return bpy.path.abspath(chosen) if chosen else ""


def _found(context: bpy.types.Context) -> environment.FoundPython | None:
    return environment.find_python(
        variable=environment.chosen_text(os.environ),
        preference=_preferred(context),
        managed=managed_folder(context),
    )


def _is_free(cls: type[bpy.types.Operator]) -> bool:
    if jobs.running() is not None:
        cls.poll_message_set(_BUSY)
        return False
    return True


def _run(
    operator: bpy.types.Operator,
    title: str,
    command: tuple[str, ...],
    *,
    python: Path | None = None,
    folder: Path | None = None,
) -> set[str]:
    """Run a job of the environment; what it finds out about the Python is kept."""
    followed: list[jobs.RunningJob] = []

    def keep() -> None:
        # An installation that fails leaves the Python as it was, and so does a check that is stopped.
        for job in followed:
            if python is not None and (job.finished or not (job.cancelling or folder)):
                environment.remember(python, job.checks, finished=job.finished)

    try:
        logs = user_folder("logs", create=True)
        jobs.start(
            title,
            command,
            folder=logs if folder is None else folder.parent,
            log_path=logs / f"{operator.bl_idname.rpartition('_OT_')[2]}.log",
            on_finished=lambda _: iter(()),
            on_end=keep,
            about_scene=False,
        )
    except (jobs.JobError, OSError) as error:
        operator.report({"ERROR"}, str(error))
        return {"CANCELLED"}
    if (job := jobs.running()) is not None:
        followed.append(job)
    return jobs.follow(operator)
