"""The settings of a scene: what the user chose, and nothing about what runs.

Everything is in `scene.fewview`, one group, and is saved with the .blend.
"""

import bpy
from bpy.props import (
    BoolProperty,
    CollectionProperty,
    EnumProperty,
    FloatProperty,
    IntProperty,
    PointerProperty,
    StringProperty,
)

from ..backend.point_methods import PointMethod

IN_BLEND = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5) else set()
"""Options of a path in which // is the folder of the .blend; Blender before 4.5 allows it in every one."""


class FEWVIEW_PG_image(bpy.types.PropertyGroup):
    """One photograph of the list"""

    path: StringProperty(name="File", subtype="FILE_PATH", options=IN_BLEND)
    use: BoolProperty(name="Use", description="Reconstruct from this photograph", default=True)
    width: IntProperty(name="Width", description="In pixels; 0 where it is not known")
    height: IntProperty(name="Height", description="In pixels; 0 where it is not known")
    problem: StringProperty(name="Problem", description="Why this photograph may not be usable")


class FEWVIEW_PG_settings(bpy.types.PropertyGroup):
    """Settings of FewView"""

    # 1. Images
    source: EnumProperty(
        name="Source",
        items=[
            ("FILES", "Photographs", "Image files from a disk"),
            ("RENDER", "Render from Scene", "Views of an object of this scene, with exact cameras"),
        ],
    )
    images: CollectionProperty(type=FEWVIEW_PG_image)
    active_image: IntProperty(name="Active Photograph")
    masks: StringProperty(
        name="Masks",
        description="Folder with an image per photograph, white on the subject; may be empty",
        subtype="DIR_PATH",
        options=IN_BLEND,
    )

    # 1b. Render from scene
    target: PointerProperty(
        name="Object",
        description="Object to look at; the active one where this is empty",
        type=bpy.types.Object,
    )
    view_cameras: EnumProperty(
        name="Cameras",
        items=[
            ("GENERATED", "Generated", "Cameras that Generate Cameras made around the object"),
            ("SELECTED", "Selected", "The selected cameras"),
            ("ANIMATED", "Animated", "The scene's camera, at every so many frames"),
        ],
    )
    layout: EnumProperty(
        name="Layout",
        items=[
            ("ARC", "Arc", "Side by side in front of the object"),
            ("RING", "Ring", "All around the object"),
            ("HEMISPHERE", "Hemisphere", "All around and from above"),
        ],
    )
    view_count: IntProperty(
        name="Views", description="Number of cameras", default=6, min=2, max=1000, soft_max=20
    )
    arc: FloatProperty(
        name="Arc",
        description="Angle between the first camera and the last",
        subtype="ANGLE",
        default=2.0943951,
        min=0.0872665,
        max=6.1086524,
    )
    azimuth: FloatProperty(
        name="Azimuth",
        description="Middle of the arc; 0 looks along the object's Y axis",
        subtype="ANGLE",
        default=0.0,
    )
    elevation: FloatProperty(
        name="Elevation",
        description="Height of the cameras over the object, as an angle",
        subtype="ANGLE",
        default=0.34906585,
        min=-1.4835298,
        max=1.4835298,
    )
    jitter: FloatProperty(
        name="Irregularity",
        description="How irregularly the cameras stand, as if held by hand",
        subtype="FACTOR",
        default=0.3,
        min=0.0,
        max=1.0,
    )
    view_seed: IntProperty(name="Seed", description="Of the irregularity", default=0, min=0)
    radius: FloatProperty(
        name="Distance",
        description="Of the cameras from the object; 0 fits the object into every picture",
        subtype="DISTANCE",
        default=0.0,
        min=0.0,
    )
    lens_mm: FloatProperty(
        name="Focal Length",
        description="Of generated cameras",
        subtype="DISTANCE_CAMERA",
        default=50.0,
        min=1.0,
    )
    frame_step: IntProperty(name="Every", description="Frames between two views", default=10, min=1)
    engine: EnumProperty(
        name="Engine",
        items=[
            ("CYCLES", "Cycles", "Realistic, on any computer"),
            ("WORKBENCH", "Workbench", "Quick, without light and materials of the scene"),
            ("SCENE", "As the Scene", "The scene's own render engine"),
        ],
    )
    samples: IntProperty(name="Samples", description="Light paths per pixel in Cycles", default=32, min=1)
    resolution_x: IntProperty(
        name="Resolution X",
        description="Width of the pictures",
        default=800,
        min=32,
        max=8192,
        subtype="PIXEL",
    )
    resolution_y: IntProperty(
        name="Resolution Y",
        description="Height of the pictures",
        default=600,
        min=32,
        max=8192,
        subtype="PIXEL",
    )

    # 2. Cameras
    camera_source: EnumProperty(
        name="Cameras",
        items=[
            ("ESTIMATE", "Estimate", "Find from the photographs where they were taken"),
            ("KNOWN", "Known", "Read them from a file: transforms.json, or a COLMAP model"),
        ],
    )
    cameras_path: StringProperty(
        name="File or Folder",
        description="A transforms.json, or the folder of a COLMAP model or of a finished run's results",
        subtype="FILE_PATH",
        options=IN_BLEND,
    )
    cameras_job: StringProperty(
        name="Cameras Job",
        description="Folder with the cameras found in step 2",
        subtype="DIR_PATH",
        options=IN_BLEND,
    )
    root: PointerProperty(
        name="Placement",
        description="Empty that places the estimated cameras and their mesh in the scene",
        type=bpy.types.Object,
    )

    # 3. Region
    region: PointerProperty(
        name="Region",
        description="Sphere around what is to be reconstructed; found automatically where this is empty",
        type=bpy.types.Object,
    )

    # 4. Reconstruct
    preset: EnumProperty(
        name="Preset",
        items=[
            ("fast", "Fast", "A first look"),
            ("balanced", "Balanced", "Good for most subjects"),
            ("detailed", "Detailed", "Over twice as long, finer colors; for sharp and large photographs"),
            ("nerf", "NeRF", "For comparison: a radiance field, slow and with a rougher mesh"),
            ("neus", "NeuS", "For comparison: a network of distance learned by rendering alone, slow"),
            ("sparsecraft", "SparseCraft", "For comparison: the same with a hash grid and points, slow"),
            ("neus-published", "NeuS, Full Size", "As published: for a large GPU, and hours of it"),
            ("sparsecraft-published", "SparseCraft, Full Size", "As published: for a large GPU"),
        ],
        default="balanced",
    )
    cut_out: BoolProperty(
        name="Cut Out Subject",
        description=(
            "Keep only what stands out in the photographs, where they have no masks. The network that "
            "tells it is fetched from the internet once (179 MB)"
        ),
        default=False,
    )
    without_ground: BoolProperty(
        name="Without Ground",
        description="Leave out the flat ground that the subject stands on. Masks do that by themselves",
        default=False,
    )
    device: EnumProperty(
        name="Device",
        items=[
            ("auto", "Automatic", "CUDA where there is one, else the processor"),
            ("cpu", "CPU", "The processor"),
            ("cuda", "CUDA", "A GPU by NVIDIA"),
            ("mps", "MPS", "The GPU of a Mac with Apple silicon"),
        ],
    )
    seed: IntProperty(
        name="Seed", description="Random seed: the same one gives the same result", default=0, min=0
    )
    output: StringProperty(
        name="Output",
        description="Folder for jobs; beside the .blend, or the one of the preferences, where this is empty",
        subtype="DIR_PATH",
        options=IN_BLEND,
    )
    truth: StringProperty(
        name="Truth",
        description="Mesh file that the result is measured against",
        subtype="FILE_PATH",
        options=IN_BLEND,
    )

    # Points alone
    point_method: EnumProperty(
        name="Method",
        items=[
            (PointMethod.LINEAR, "Linear", "The smoothest field that agrees with the points, in seconds"),
            (
                PointMethod.NEURAL_PULL,
                "Neural-Pull",
                "For comparison: a network that pulls points onto the surface, slow",
            ),
            (PointMethod.NAP, "NAP", "For comparison: a network pulled from the worst places nearby, slow"),
            (PointMethod.SDRO, "SDRO", "For comparison: a network against the worst samples, slow"),
            (
                PointMethod.ENTROPY,
                "Entropy",
                "For comparison: a network undecided on the surface alone, slow",
            ),
        ],
    )
    point_normals: BoolProperty(
        name="Normals Are Known",
        description="The surface shall face as the points' attribute normal says, or else the mesh's faces",
        default=False,
    )

    # 5. Result
    result: PointerProperty(name="Result", description="Mesh that was imported last", type=bpy.types.Object)
    decimate_ratio: FloatProperty(
        name="Ratio",
        description="Share of triangles to keep",
        subtype="FACTOR",
        default=0.25,
        min=0.001,
        max=1.0,
    )


CLASSES = (FEWVIEW_PG_image, FEWVIEW_PG_settings)


def register() -> None:
    """Give every scene its settings."""
    bpy.types.Scene.fewview = PointerProperty(type=FEWVIEW_PG_settings)


def unregister() -> None:
    """Take the settings away; what is saved in .blend files stays there."""
    del bpy.types.Scene.fewview


def settings_of(context: bpy.types.Context) -> FEWVIEW_PG_settings:
    """The settings of the scene that is worked on."""
    return context.scene.fewview
