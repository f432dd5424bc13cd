"""Our own firmware over HID: its bytes in reports, and the contract of all flashes through them."""

import pytest
from flash_contract import FlashContract, FlashRig
from flash_doubles import StepLine, SteppedCore, build
from hypothesis import given
from hypothesis import strategies as st

from capture.devices.bench import Bench
from capture.devices.firmware_flash.flash import open_firmware_flash
from capture.devices.hid.firmware import REPORT_BYTES, ReportLine, to_reports
from capture.devices.hid.transport import HidAddress
from firmware_protocol import Decoder, Hello, Packet, Ping, Stop, encode

ADDRESS = HidAddress(
    path="/dev/hidraw0", vendor_id=1, product_id=2, product="relight flash", usage_page=0xFF52
)


def packets(reports):
    decoder = Decoder()
    return [found for report in reports for found in decoder.feed(report)]


def test_a_frame_is_one_report_filled_with_zeros():
    frame = encode(Stop(), 7)
    (report,) = to_reports(frame)
    assert report == frame + bytes(REPORT_BYTES - len(frame))


def test_a_report_on_its_way_out_has_the_id_0_before_it():
    class Sink:
        address = ADDRESS
        sent = ()

        def write(self, report):
            self.sent += (report,)

    sink = Sink()
    ReportLine(sink).write(encode(Ping(1), 1))
    (report,) = sink.sent
    assert len(report) == 1 + REPORT_BYTES
    assert report[0] == 0


def test_the_longest_frame_fits():
    frame = encode(Hello(1, 0, 2, 3, 4, 5, "x" * 24), 1)
    assert len(frame) <= REPORT_BYTES
    assert len(to_reports(frame)) == 1


@given(st.lists(st.sampled_from([Stop(), Ping(2**63), Hello(1, 0, 0, 0, 0, 0, "y" * 24)]), max_size=12))
def test_no_frame_is_cut_and_a_lost_report_costs_only_its_own(messages):
    stream = b"".join(encode(message, 1 + number) for number, message in enumerate(messages))
    reports = to_reports(stream)
    assert all(len(report) == REPORT_BYTES for report in reports)
    assert packets(reports) == [Packet(1 + number, message) for number, message in enumerate(messages)]
    for lost in range(len(reports)):
        rest = packets(reports[:lost] + reports[lost + 1 :])
        assert len(rest) + len(packets([reports[lost]])) == len(messages)
        assert all(isinstance(found, Packet) for found in rest)


def test_text_that_is_longer_than_a_report_comes_through():
    text = b"a banner\n" * 20 + b"\0"
    assert b"".join(to_reports(text)).rstrip(b"\0") + b"\0" == text


class Reports:
    """A `HidTransport` to the firmware in simulated time, which sends whole frames in each report."""

    address = ADDRESS

    def __init__(self, line):
        self._line = line
        self._stream = b""
        self._queue = []

    def write(self, report):
        assert len(report) == 1 + REPORT_BYTES
        self._line.write(report[1:])

    def read(self, timeout_s):
        end_s = self._line.now_s() + timeout_s
        while True:
            self._stream += self._line.read(max(0.0, end_s - self._line.now_s()))
            whole, delimiter, rest = self._stream.rpartition(b"\0")
            if delimiter:
                self._stream = rest
                self._queue += to_reports(whole + delimiter)
            if self._queue or self._line.now_s() >= end_s:
                return self._queue.pop(0) if self._queue else b""

    def close(self):
        self._line.close()


class ReportRig(FlashRig):
    def __init__(self, line):
        self.line = self.clock = line

    def open(self):
        self.line.closed = False
        return open_firmware_flash(
            ReportLine(Reports(self.line)), Bench(self.line), url="hid-firmware:", back_end="hid-firmware"
        )

    def lamp(self):
        return self.line.lamp()

    def kill_host(self):
        """Nobody polls any more: the whole host is what the test's thread does."""


class TestContractInReports(FlashContract):
    @pytest.fixture
    def rig(self, tmp_path_factory):
        base = tmp_path_factory.getbasetemp()  # of a run in several processes, the one that they share
        base = base.parent if base.name.startswith("popen-") else base
        device = SteppedCore(build(base / "flash_doubles", "core"))
        yield ReportRig(StepLine(device))
        device.close()
