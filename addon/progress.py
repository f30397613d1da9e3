"""How far a job is and how long it will take, from the stage it is in; no Blender needed."""

STAGE_SECONDS = {
    "photos": 1.0,
    "cameras": 4.0,
    "cutout": 15.0,
    "region": 0.5,
    "stereo": 5.0,
    "train": 9.0,
    "mesh": 3.0,
    "report": 4.0,
    "python": 5.0,
    "packages": 90.0,
    "check": 8.0,
    "points": 0.5,
    "surface": 12.0,
}
"""What stages typically take beside each other, for the share of the whole; another one counts as 1."""

_RUNS = (
    ("photos", "cameras", "region", "stereo", "train", "mesh", "report"),
    ("photos", "cameras", "cutout", "region", "stereo", "train", "mesh", "report"),
    ("points", "surface", "mesh"),
    ("python", "packages", "check"),
)
"""Which stages follow one another, so that what is left can be told."""

STAGE_WORDS = {
    "photos": "Reading photographs",
    "cameras": "Placing cameras",
    "cutout": "Cutting out the subject",
    "region": "Finding the subject",
    "stereo": "Comparing photographs",
    "train": "Fitting the surface",
    "mesh": "Making the mesh",
    "report": "Writing the report",
    "render": "Rendering views",
    "python": "Preparing Python",
    "packages": "Installing packages",
    "check": "Checking",
    "points": "Reading points",
    "surface": "Fitting the surface",
}
_MOST_STAGES = 100
"""More are not believed."""
_LEAST_SHARE = 0.04
"""Before that, nothing can be said of the time left."""


def stage_words(name: str) -> str:
    """The stage in words for the user."""
    return STAGE_WORDS.get(name, name.replace("_", " ").capitalize())


def total_share(stages_before: list[str], stage: str, num_left: int, fraction: float) -> float:
    """Share of the whole job, 0 to 1, in a stage after others and before `num_left` of unknown names."""
    done = sum(_seconds(name) for name in stages_before)
    this = _seconds(stage)
    num_left = min(max(num_left, 0), _MOST_STAGES)
    rests = [run[run.index(stage) + 1 :] for run in _RUNS if stage in run]
    following = next((rest for rest in rests if len(rest) == num_left), rests[0] if rests else ())
    left = sum(_seconds(name) for name in following[:num_left]) + max(num_left - len(following), 0)
    return min(max((done + fraction * this) / (done + this + left), 0.0), 1.0)


def seconds_left(share: float, elapsed_s: float) -> float | None:
    """At the pace so far; None at the beginning."""
    return None if share < _LEAST_SHARE else elapsed_s * (1.0 - share) / share


def time_words(seconds: float) -> str:
    """A time as people say it."""
    if seconds < 55:
        return f"{max(5 * round(seconds / 5), 5)} s"
    if seconds < 90 * 60:
        return f"{max(round(seconds / 60), 1)} min"
    return f"{seconds / 3600:.1f} h"


def _seconds(stage: str) -> float:
    return STAGE_SECONDS.get(stage, 1.0)
