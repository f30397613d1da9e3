"""The sidebar."""


def draw_environment(layout: object, context: object) -> None:
    """The state of the backend."""
