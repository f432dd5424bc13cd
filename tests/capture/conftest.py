"""What tests share: damage to a file's content, a place to put it, and one simulated rig for all."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import strategies as st

from capture.sim import RigConfig
from capture.sim.rig import Rig

Damage = Callable[[bytes], st.SearchStrategy[bytes]]


@pytest.fixture(scope="session")
def damage() -> Damage:
    """Strategy of damaged forms of a content: cut anywhere, overwritten, with bytes put in, garbage."""

    def damaged(content: bytes) -> st.SearchStrategy[bytes]:
        places = st.integers(0, len(content))
        scraps = st.binary(min_size=1, max_size=9) | st.sampled_from(
            [b"NaN", b"-1", b"1e999", b"null", b"[]", b"{}", b"\xff" * 8, b"\0" * 8, b"9" * 25, b"\n"]
        )
        return st.one_of(
            places.map(lambda at: content[:at]),
            st.builds(lambda at, scrap: content[:at] + scrap + content[at + len(scrap) :], places, scraps),
            st.builds(lambda at, scrap: content[:at] + scrap + content[at:], places, scraps),
            st.binary(max_size=200),
        )

    return damaged


@pytest.fixture(scope="session")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for files that every example overwrites."""
    return tmp_path_factory.mktemp("scratch")


@pytest.fixture(scope="session")
def built_rig():
    return Rig.build(RigConfig.small())


@pytest.fixture
def one_rig(built_rig, monkeypatch):
    """They differ in path, rate and sensor, which nothing that takes long depends on."""
    monkeypatch.setattr(Rig, "build", lambda config: replace(built_rig, config=config))
    return built_rig
