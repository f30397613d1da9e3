"""views."""

CLASSES = ()
