"""Where the firmware is built for the tests of its host."""

import pytest


@pytest.fixture(scope="session")
def firmware_directory(tmp_path_factory):
    """Of all test processes of one run."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if base.name.startswith("popen-") else base) / "flash_doubles"
