"""A HID device that is a list: what has to be sent, byte for byte, and what it says.

with expected_exchange([("out", b"..."), ("in", b"...")], address) as transport:
    ...
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from capture.devices.hid.transport import HidAddress


class ExpectedExchange:
    """A `HidTransport`: "out" and "set" have to be sent next, "in" and "get" are what comes back."""

    def __init__(self, exchange: Sequence[tuple[str, bytes]], address: HidAddress) -> None:
        self.address = address
        self.left = list(exchange)

    def write(self, report: bytes) -> None:
        self._take("out", report)

    def read(self, timeout_s: float) -> bytes:
        return self.left.pop(0)[1] if self.left and self.left[0][0] == "in" else b""

    def send_feature(self, report: bytes) -> None:
        self._take("set", report)

    def get_feature(self, report_id: int, length: int) -> bytes:
        assert self.left, f"report {report_id} was asked for, but nothing more was expected"
        kind, content = self.left.pop(0)
        assert kind == "get", f"report {report_id} was asked for; expected: {kind} {content.hex(' ')}"
        return content[:length]

    def close(self) -> None:
        pass

    def _take(self, kind: str, report: bytes) -> None:
        assert self.left, f"{kind} {report.hex(' ')}, but nothing more was expected"
        expected = self.left.pop(0)
        assert (kind, report) == expected, (
            f"{kind} {report.hex(' ')}; expected: {expected[0]} {expected[1].hex(' ')}"
        )


@contextmanager
def expected_exchange(
    exchange: Sequence[tuple[str, bytes]], address: HidAddress
) -> Iterator[ExpectedExchange]:
    """The device; at the end all of the exchange has to have happened."""
    transport = ExpectedExchange(exchange, address)
    yield transport
    assert not transport.left, f"{len(transport.left)} more expected, next: {transport.left[0]}"
