import pytest

from capture.sim import Rig, RigConfig


@pytest.fixture(scope="session")
def small_rig() -> Rig:
    return Rig.build(RigConfig.small())
