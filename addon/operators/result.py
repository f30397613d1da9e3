"""result."""

CLASSES = ()
