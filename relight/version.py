"""Which version this is."""

from importlib.metadata import PackageNotFoundError, version


def installed_version() -> str:
    """Version of the installed distribution; says so when the code runs without being installed."""
    try:
        return version("relightable-portrait-rig")
    except PackageNotFoundError:
        return "not installed"
