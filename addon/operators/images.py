"""images."""

CLASSES = ()
