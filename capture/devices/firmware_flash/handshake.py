"""HELLO until the device answers, through the noise of a boot loader; and who answered instead.

Opening a port resets many boards, which then spend up to two seconds in a boot loader.
"""

from __future__ import annotations

from capture.devices.firmware_flash.link import FirmwareLink
from capture.errors import FlashError
from firmware_protocol import Decoder, Err, Fault, FaultReason, Hello, Packet, Stop
from firmware_protocol.limits import PROTOCOL_MAJOR, PROTOCOL_MINOR, WIRE_VERSION
from firmware_protocol.messages import Capability, schema_crc

HELLO_EACH_S = 0.25
PATIENCE_S = 5.0
#: A burst of round trips, so that the first train finds a clock that is known.
BURST = 8
#: The device stays dark for so long after its start and refuses trains that begin sooner (PROTOCOL.md).
DARK_S = 1.0
HOST_NAME = "relight-capture"
_BURST_PAUSE_S = 0.03
_SHOWN_BYTES = 48


def shake_hands(link: FirmwareLink, *, after_reset: bool = False, patience_s: float = PATIENCE_S) -> Hello:
    """Finds the device, checks its version, learns its clock, and waits until it may flash.

    Takes half a second when the device is there; `patience_s` and two seconds more at most.

    Args:
        link: To a device that is not known yet.
        after_reset: It is known to have started just now.
        patience_s: How long it may take to answer.

    Raises:
        FlashError: Nothing answered, or something that is not this firmware, or another version of it.
        FlashGoneError: The line went away.
    """
    begin_s = link.now_s()
    end_s = begin_s + patience_s
    while True:
        hello = _find(link, end_s)
        found_s = link.now_s()
        link.accept(hello)
        link.send(Stop(), flush=True)  # a train of a host before us
        link.heartbeat = True
        for _ in range(BURST):
            link.ping()
            _tend_for(link, _BURST_PAUSE_S)
        clock = link.clock
        if clock is not None and clock.fit.ready and not link.restarted:
            break
        link.forget()  # it answered, and only then did the reset come; or its PONGs do not
    # A counter begins with the device: a young one is in its second of darkness. One that did not answer
    # at once may have been starting.
    young_s = clock.fit.device(link.now_s()) / hello.tick_hz
    if after_reset or found_s - begin_s > HELLO_EACH_S:
        young_s = min(young_s, link.now_s() - found_s)
    if young_s < DARK_S:
        _tend_for(link, DARK_S - young_s + _BURST_PAUSE_S)
    return hello


def _tend_for(link: FirmwareLink, seconds: float) -> None:
    end_s = link.now_s() + seconds
    while (left_s := end_s - link.now_s()) > 0:
        link.tend(left_s)


def _find(link: FirmwareLink, end_s: float) -> Hello:
    decoder = Decoder()
    heard = bytearray()
    doubt = ""
    next_s = link.now_s()
    while (now_s := link.now_s()) < end_s:
        if now_s >= next_s:
            link.send(Hello.from_host(HOST_NAME), flush=True)
            next_s = now_s + HELLO_EACH_S
        data = link.transport.read(max(0.0, min(next_s, end_s) - now_s))
        heard += data
        for item in decoder.feed(data):
            found, why = _judge(item)
            if found is not None:
                _check_version(found, link.description)
                return found
            doubt = why or doubt
    raise FlashError(f"{link.description} {doubt or _who_else(bytes(heard))}")


def _judge(item: Packet | Fault) -> tuple[Hello | None, str]:
    """The device's HELLO, or what else this may mean if none comes."""
    if isinstance(item, Fault):
        if item.reason is FaultReason.VERSION:
            return None, f"talks, but: {item.detail}; update the firmware or this program."
        return None, ""
    message = item.message
    if isinstance(message, Err):
        return None, (
            f"refuses this program's HELLO with error {message.code} (its limit is {message.limit}): it has "
            f"another version than wire {WIRE_VERSION}, protocol {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}; update "
            "the firmware or this program."
        )
    if isinstance(message, Hello):
        if message.boot_nonce and message.tick_hz:
            return message, ""
        return None, "only echoes what is sent to it; this is a loopback or a modem, not the flash."
    return None, ""


def _check_version(hello: Hello, description: str) -> None:
    if hello.protocol_major != PROTOCOL_MAJOR:
        raise FlashError(
            f"{description} ({hello.name}) speaks protocol {hello.protocol_major}.{hello.protocol_minor}, "
            f"this program {PROTOCOL_MAJOR}.{PROTOCOL_MINOR}; update the older of the two."
        )
    if hello.schema_crc != schema_crc():
        raise FlashError(
            f"{description} ({hello.name}) was built from other message layouts (0x{hello.schema_crc:04x}, "
            f"here 0x{schema_crc():04x}); build the firmware from the sources beside this program."
        )
    if not hello.capabilities & Capability.SCHEDULE:
        raise FlashError(f"{description} ({hello.name}) cannot run a train of flashes by its own clock.")


def _who_else(heard: bytes) -> str:
    if not heard.strip(b"\0"):
        return (
            f"has not answered in {PATIENCE_S:.0f} s; check that it is the port of the flash and that the "
            "firmware is on the board (firmware_protocol/firmware: make flash)."
        )
    shown = heard[-_SHOWN_BYTES:].decode("ascii", "replace")
    text = "".join(c if c.isprintable() and c != "�" else "." for c in shown)
    return (
        f'is not the flash: {len(heard)} bytes came, none of them its protocol, the last being "{text}"; '
        "name another port, or put the firmware on the board (firmware_protocol/firmware: make flash)."
    )
