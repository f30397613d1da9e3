"""environment."""

CLASSES = ()
