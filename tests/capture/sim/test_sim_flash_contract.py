"""The simulated flash keeps the contract of all flashes."""

import pytest
from flash_contract import FlashContract, FlashRig

from capture.devices.bench import Bench, VirtualClock
from capture.devices.table import open_flash


class SimulatedRig(FlashRig):
    def __init__(self):
        self.bench = Bench(VirtualClock())
        self.clock = self.bench.clock

    def open(self):
        return open_flash("sim:", self.bench)

    def lamp(self):
        now_s = self.clock.now_s()
        edges = [
            (at, on) for pulse in self.bench.light.pulses for at, on in zip(pulse, (True, False), strict=True)
        ]
        return sorted(edge for edge in edges if edge[0] <= now_s)


class TestSimulatedFlash(FlashContract):
    @pytest.fixture
    def rig(self):
        return SimulatedRig()
