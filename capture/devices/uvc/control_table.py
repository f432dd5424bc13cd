"""The controls of UVC: which entity and selector a control has, and how its value lies in the bytes.

Selectors, lengths and signs: UVC 1.5, tables A-12 (camera terminal) and A-13 (processing unit) and sections
4.2.2.1 and 4.2.2.3; the bit of `bmControls` that announces a control: tables 3-6 and 3-8. Selector 4 is the
exposure time in a camera terminal and the gain in a processing unit: a control is always addressed by both.
"""

from __future__ import annotations

from dataclasses import dataclass

from capture.devices.uvc.descriptors import Entity


@dataclass(frozen=True, kw_only=True)
class Control:
    """One number that can be set.

    Attributes:
        name: Ours.
        entity: Where it lives.
        selector: `CS` of its requests.
        bit: Of the entity's `bmControls`.
        length: Bytes of the request.
        offset: Where the number begins in them.
        size: Bytes of the number.
        signed: Two's complement.
        unit: What it counts.
    """

    name: str
    entity: Entity
    selector: int
    bit: int
    length: int
    offset: int
    size: int
    signed: bool
    unit: str

    def decode(self, data: bytes) -> int:
        """The number in a request's data."""
        field = data[self.offset : self.offset + self.size]
        return int.from_bytes(field, "little", signed=self.signed)

    def encode(self, value: int, around: bytes) -> bytes:
        """A request's data with the number in it, and the rest as it is `around` it."""
        field = value.to_bytes(self.size, "little", signed=self.signed)
        return around[: self.offset] + field + around[self.offset + self.size :]

    @property
    def span(self) -> tuple[int, int]:
        """The least and the greatest number that its bytes can hold."""
        bits = 8 * self.size
        return (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if self.signed else (0, (1 << bits) - 1)


def _table(entity: Entity, *rows: tuple[str, int, int, str, str]) -> dict[str, Control]:
    """Rows of name, selector, bit, layout and unit; a layout is "u2", or "s4@4/8" at byte 4 of 8."""
    controls = {}
    for name, selector, bit, layout, unit in rows:
        kind, _, place = layout.partition("@")
        offset, _, length = place.partition("/")
        size = int(kind[1:])
        controls[name] = Control(
            name=name,
            entity=entity,
            selector=selector,
            bit=bit,
            length=int(length or size),
            offset=int(offset or 0),
            size=size,
            signed=kind[0] == "s",
            unit=unit,
        )
    return controls


CONTROLS = {
    **_table(
        Entity.CAMERA_TERMINAL,
        ("auto_exposure_mode", 0x02, 1, "u1", "1 manual, 2 auto, 4 shutter priority, 8 aperture priority"),
        ("auto_exposure_priority", 0x03, 2, "u1", "1 = the frame rate may drop"),
        ("exposure_time_absolute", 0x04, 3, "u4", "100 us"),
        ("focus_absolute", 0x06, 5, "u2", "mm by the specification, steps in most cameras"),
        ("focus_auto", 0x08, 17, "u1", "1 = on"),
        ("iris_absolute", 0x09, 7, "u2", "f-number x 100"),
        ("zoom_absolute", 0x0B, 9, "u2", "focal length, device units"),
        ("pan_absolute", 0x0D, 11, "s4@0/8", "arc seconds"),
        ("tilt_absolute", 0x0D, 11, "s4@4/8", "arc seconds"),
        ("roll_absolute", 0x0F, 13, "s2", "degrees"),
        ("privacy", 0x11, 18, "u1", "1 = shut"),
    ),
    **_table(
        Entity.PROCESSING_UNIT,
        ("backlight_compensation", 0x01, 8, "u2", "0 = off"),
        ("brightness", 0x02, 0, "s2", "device units"),
        ("contrast", 0x03, 1, "u2", "device units"),
        ("gain", 0x04, 9, "u2", "device units"),
        ("power_line_frequency", 0x05, 10, "u1", "0 off, 1 50 Hz, 2 60 Hz, 3 auto"),
        ("hue", 0x06, 2, "s2", "degrees x 100"),
        ("saturation", 0x07, 3, "u2", "device units"),
        ("sharpness", 0x08, 4, "u2", "device units"),
        ("gamma", 0x09, 5, "u2", "gamma x 100"),
        ("white_balance_temperature", 0x0A, 6, "u2", "kelvin"),
        ("white_balance_temperature_auto", 0x0B, 12, "u1", "1 = on"),
        ("white_balance_blue", 0x0C, 7, "u2@0/4", "device units"),
        ("white_balance_red", 0x0C, 7, "u2@2/4", "device units"),
        ("white_balance_component_auto", 0x0D, 13, "u1", "1 = on"),
        ("digital_multiplier", 0x0E, 14, "u2", "device units"),
        ("digital_multiplier_limit", 0x0F, 15, "u2", "device units"),
        ("hue_auto", 0x10, 11, "u1", "1 = on"),
        ("contrast_auto", 0x13, 18, "u1", "1 = on"),
    ),
}
