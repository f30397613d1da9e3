"""region."""

CLASSES = ()
