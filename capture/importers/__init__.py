"""From what a camera, a tool or a data set left behind to a session."""

from capture.importers.dispatch import import_source
from capture.importers.options import ImportOptions

__all__ = ["ImportOptions", "import_source"]
