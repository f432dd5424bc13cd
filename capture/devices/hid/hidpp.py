"""Logitech's HID++ 2.0 as far as a lamp needs it: long reports, features by number, replies, events.

A report has 20 bytes: 11, device ff (the one on the cable), index of the feature, function in the high and
the asker's own number in the low half of a byte, parameters, zeros. The device answers each with the same
four bytes. A report with the asker's number 0 was not asked for: somebody has pressed a button. An error is
11 ff ff, then index and function of what was refused, then a code. (timrogers/litra-rs; Logitech's HID++ 2.0
draft; A. Bergmeier on linux-input, 2022-12-15.)
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from capture.devices.bench import Clock
from capture.devices.hid.transport import HidTransport
from capture.errors import FlashError

_LONG, _CABLE, _ERROR = 0x11, 0xFF, 0xFF
_BYTES = 20
_ROOT, _GET_FEATURE = 0x00, 0x0C
#: So long the device may take for an answer; on USB it takes some milliseconds.
ANSWER_S = 0.3


@dataclass(frozen=True)
class Event:
    """A report that was not asked for.

    Attributes:
        feature_index: Of the feature it belongs to.
        number: Of the event within the feature.
        parameters: The rest.
    """

    feature_index: int
    number: int
    parameters: bytes


class HidppLink:
    """Questions and commands to one device, and its events.

    Attributes:
        unanswered: When commands were given that have not been answered, oldest first.
        events: That nobody has taken yet.
    """

    def __init__(self, transport: HidTransport, clock: Clock) -> None:
        """Takes over an opened device."""
        self.unanswered: deque[tuple[int, int, float]] = deque()
        self.events: deque[Event] = deque()
        self._transport = transport
        self._clock = clock

    @property
    def name(self) -> str:
        """Of the device, for messages."""
        return self._transport.address.description

    def feature_index(self, feature: int) -> int | None:
        """Under which index the device has a feature; 0 = it has not; None = it does not answer."""
        answer = self.ask(_ROOT, _GET_FEATURE, feature.to_bytes(2, "big"))
        return None if answer is None else answer[0]

    def ask(self, feature_index: int, function: int, parameters: bytes = b"") -> bytes | None:
        """Sends a question and waits for its answer.

        Args:
            feature_index: Of the feature that is asked.
            function: With the asker's number in the low half.
            parameters: At most 16 bytes.

        Returns:
            The answer's 16 parameters; None = none came in time.

        Raises:
            FlashError: The device refuses.
        """
        deadline_s = self._clock.now_s() + ANSWER_S
        self._send(feature_index, function, parameters)
        while (left_s := deadline_s - self._clock.now_s()) > 0:
            report = self._transport.read(left_s)
            if not report:
                break
            if self._sort(report) == (feature_index, function):
                return report[4:]
        return None

    def tell(self, feature_index: int, function: int, parameters: bytes = b"") -> None:
        """Sends a command without waiting; `listen` notices its answer."""
        self.unanswered.append((feature_index, function, self._clock.now_s()))
        self._send(feature_index, function, parameters)

    def listen(self) -> None:
        """Takes all reports that have come: answers to commands, and events.

        Raises:
            FlashError: The device has refused a command.
        """
        while report := self._transport.read(0.0):
            self._sort(report)

    def _send(self, feature_index: int, function: int, parameters: bytes) -> None:
        self._transport.write(
            bytes((_LONG, _CABLE, feature_index, function)) + parameters.ljust(_BYTES - 4, b"\0")
        )

    def _sort(self, report: bytes) -> tuple[int, int] | None:
        """Which feature and function a report answers; None = none of ours. Keeps events."""
        if len(report) < _BYTES or report[0] != _LONG:
            return None
        index, function = report[2], report[3]
        if index == _ERROR:
            raise FlashError(
                f"{self.name} refuses a command (feature {report[3]:#04x}, function {report[4]:#04x}, "
                f"HID++ error {report[5]}); unplug it and plug it in again, or update its firmware."
            )
        if function & 0x0F == 0:
            self.events.append(Event(index, function >> 4, report[4:]))
            return None
        # Answers come in the order of the commands; one that was lost is passed over.
        for position, (asked_index, asked_function, _) in enumerate(self.unanswered):
            if (asked_index, asked_function) == (index, function):
                for _ in range(position + 1):
                    self.unanswered.popleft()
                break
        return index, function
