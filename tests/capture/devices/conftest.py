"""What the tests of devices share."""

import pytest

# Before they are imported: so that a failed assertion of theirs says what was compared.
pytest.register_assert_rewrite("flash_contract", "camera_contract")


@pytest.fixture(scope="session")
def firmware_directory(tmp_path_factory):
    """Where the flash firmware is built for the tests of its host; one for all test processes of a run."""
    base = tmp_path_factory.getbasetemp()
    return (base.parent if base.name.startswith("popen-") else base) / "flash_doubles"
