"""The codec against golden vectors, an independent reference, and hostile bytes."""

import json
from dataclasses import asdict, fields
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import firmware_protocol
from firmware_protocol import MESSAGE_TYPES, Decoder, Fault, FaultReason, Packet, ProtocolError, encode
from firmware_protocol.cobs import stuff, unstuff
from firmware_protocol.crc import crc16_mcrf4xx
from firmware_protocol.limits import (
    FULL_LEVEL,
    MAX_BODY_BYTES,
    MAX_ON_MS,
    MAX_PAYLOAD_BYTES,
    MAX_RATE_HZ,
    MAX_WIRE_BYTES,
    MIN_PERIOD_US,
)
from firmware_protocol.messages import (
    Edge,
    Err,
    Event,
    Hello,
    Message,
    Ping,
    Pong,
    Set,
    Stat,
    State,
    Stop,
    Train,
    schema,
    schema_crc,
)

PACKAGE = Path(firmware_protocol.__file__).parent
VECTORS = json.loads((PACKAGE / "vectors.json").read_text())
BY_NAME = {cls.__name__.upper(): cls for cls in MESSAGE_TYPES.values()}

u8, u16 = st.integers(0, 0xFF), st.integers(0, 0xFFFF)
u32, u64 = st.integers(0, 0xFFFF_FFFF), st.integers(0, 0xFFFF_FFFF_FFFF_FFFF)
names = st.text(st.characters(min_codepoint=1, max_codepoint=127), max_size=24)
messages = st.one_of(
    st.builds(Hello, u8, u8, u16, u32, u32, u32, names),
    st.builds(Ping, u64),
    st.builds(lambda nonce, t1, a, b: Pong(nonce, t1, min(a, b), max(a, b)), u32, u64, u64, u64),
    st.builds(Set, u32, u16, st.integers(0, MAX_ON_MS)),
    st.builds(
        Train,
        u32,
        u64,
        st.integers(MIN_PERIOD_US, 0xFFFF_FFFF),
        st.integers(1, MAX_ON_MS * 1000),
        st.integers(1, 0xFFFF),
        u16,
    ),
    st.just(Stop()),
    st.builds(Stat, u32, u64, st.sampled_from(State).map(int), u16, u32, u32, u32, u16),
    st.builds(Event, u32, u64, st.sampled_from(Edge).map(int), u32, u16),
    st.builds(Err, u8, u16, u32),
)
packets = st.builds(Packet, u16, messages)


def crc_bit_by_bit(data: bytes) -> int:
    """CRC-16/MCRF4XX straight from its definition: one bit at a time, no table."""
    crc = 0xFFFF
    for byte in data:
        for bit in range(8):
            low = (crc ^ byte >> bit) & 1
            crc = crc >> 1 ^ (0x8408 if low else 0)
    return crc


def stuff_by_splitting(data: bytes) -> bytes:
    """COBS for data in which no run without a zero reaches 254 bytes: every frame body here."""
    return b"".join(bytes((len(run) + 1,)) + run for run in data.split(b"\0"))


def test_the_checksum_has_its_published_check_value():
    assert crc16_mcrf4xx(b"123456789") == 0x6F91
    assert VECTORS["crc16_mcrf4xx"][0] == {"data": b"123456789".hex(), "crc": 0x6F91}


@given(st.binary(max_size=100), st.integers(0, 100))
def test_the_checksum_agrees_with_its_definition_and_continues_over_pieces(data, cut):
    assert crc16_mcrf4xx(data) == crc_bit_by_bit(data)
    assert crc16_mcrf4xx(data[cut:], crc16_mcrf4xx(data[:cut])) == crc16_mcrf4xx(data)


@given(st.binary(max_size=MAX_BODY_BYTES - 2))
def test_a_message_with_its_checksum_checks_to_zero(data):
    assert crc16_mcrf4xx(data + crc16_mcrf4xx(data).to_bytes(2, "little")) == 0


@pytest.mark.parametrize("example", VECTORS["crc16_mcrf4xx"], ids=lambda example: example["data"] or "empty")
def test_golden_checksums(example):
    assert crc_bit_by_bit(bytes.fromhex(example["data"])) == example["crc"]


@pytest.mark.parametrize("example", VECTORS["cobs"], ids=lambda example: example["data"][:16] or "empty")
def test_golden_stuffing(example):
    data, stuffed = bytes.fromhex(example["data"]), bytes.fromhex(example["stuffed"])
    assert stuff(data) == stuffed
    assert unstuff(stuffed) == data


@given(st.binary(max_size=600))
def test_stuffing_round_trips_without_zeros_at_one_byte_in_254(data):
    stuffed = stuff(data)
    assert 0 not in stuffed
    assert unstuff(stuffed) == data
    assert len(stuffed) <= len(data) + 1 + len(data) // 254


@given(st.binary(max_size=253))
def test_stuffing_agrees_with_splitting_at_the_zeros(data):
    assert stuff(data) == stuff_by_splitting(data)


@given(st.binary(max_size=80))
def test_unstuffing_any_bytes_gives_bytes_or_a_protocol_error(data):
    try:
        restored = unstuff(data)
    except ProtocolError:
        return
    assert not data or stuff(restored) == data


def test_the_layout_has_not_changed_without_its_checksum():
    assert schema().splitlines() == VECTORS["schema"]
    assert schema_crc() == VECTORS["schema_crc"] == crc_bit_by_bit(schema().encode())


def test_every_message_fits_the_longest_frame():
    for cls in MESSAGE_TYPES.values():
        assert cls.payload_bytes() <= MAX_PAYLOAD_BYTES, cls.__name__


@pytest.mark.parametrize("example", VECTORS["frames"], ids=lambda example: example["name"])
def test_golden_frames(example):
    message = BY_NAME[example["message"]](**example["fields"])
    wire = bytes.fromhex(example["wire"])
    assert encode(message, example["seq"]) == wire
    assert Decoder().feed(wire) == [Packet(example["seq"], message)]
    assert asdict(message) == example["fields"]


@pytest.mark.parametrize("example", VECTORS["frames"], ids=lambda example: example["name"])
def test_golden_frames_agree_with_an_independent_encoder(example):
    cls = BY_NAME[example["message"]]
    body = bytes((1, cls.TYPE)) + example["seq"].to_bytes(2, "little")
    sizes = dict(part.split(":") for line in VECTORS["schema"] for part in line.split()[2:])
    for name, value in example["fields"].items():
        size = {"B": 1, "H": 2, "I": 4, "Q": 8, "24s": 24}[sizes[name]]
        body += value.encode().ljust(24, b"\0") if isinstance(value, str) else value.to_bytes(size, "little")
    body += crc_bit_by_bit(body).to_bytes(2, "little")
    assert stuff_by_splitting(body) + b"\0" == bytes.fromhex(example["wire"])


@pytest.mark.parametrize("example", VECTORS["faults"], ids=lambda example: example["name"])
def test_golden_faults(example):
    decoder = Decoder()
    (fault,) = decoder.feed(bytes.fromhex(example["wire"]))
    assert isinstance(fault, Fault)
    assert (fault.reason.value, fault.seq) == (example["fault"], example["seq"])
    assert fault.detail
    assert decoder.faults == {fault.reason: 1}
    assert decoder.packets == 0


def test_the_vectors_show_every_message_and_every_fault():
    assert {example["message"] for example in VECTORS["frames"]} == set(BY_NAME)
    assert {example["fault"] for example in VECTORS["faults"]} == {reason.value for reason in FaultReason}


@given(packets)
def test_any_message_round_trips_in_one_short_frame(packet):
    wire = encode(packet.message, packet.seq)
    assert len(wire) <= MAX_WIRE_BYTES
    assert wire.index(0) == len(wire) - 1
    assert Decoder().feed(wire) == [packet]


@given(st.lists(packets, max_size=6), st.lists(st.integers(0, 400), max_size=12))
def test_the_size_of_the_pieces_does_not_matter(sent, cuts):
    stream = b"".join(encode(packet.message, packet.seq) for packet in sent)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    decoder = Decoder()
    found = [item for a, b in pairwise(edges) for item in decoder.feed(stream[a:b])]
    assert found == sent
    assert decoder.packets == len(sent)


@given(st.binary(max_size=300), packets)
def test_a_frame_after_garbage_and_a_delimiter_is_found(garbage, packet):
    decoder = Decoder()
    decoder.feed(garbage + b"\0")
    assert decoder.feed(encode(packet.message, packet.seq)) == [packet]


@given(packets, packets, st.data())
def test_losing_bytes_of_one_frame_costs_at_most_that_frame_and_the_next(first, second, data):
    wire = encode(first.message, first.seq)
    start = data.draw(st.integers(0, len(wire) - 1))
    stop = data.draw(st.integers(start + 1, len(wire)))
    third = Packet(7, Stop())
    stream = (
        wire[:start] + wire[stop:] + encode(second.message, second.seq) + encode(third.message, third.seq)
    )
    good = [item for item in Decoder().feed(stream) if isinstance(item, Packet)]
    assert good[-1] == third
    assert all(item in (second, third) for item in good)


@given(st.lists(st.binary(max_size=90), max_size=8))
def test_garbage_never_raises_and_never_piles_up(pieces):
    decoder = Decoder()
    for piece in pieces:
        for item in decoder.feed(piece):
            assert isinstance(item, Fault)
    assert len(decoder._pending) < MAX_WIRE_BYTES


def test_every_single_bit_flip_on_the_wire_is_detected():
    for example in VECTORS["frames"]:
        wire = bytes.fromhex(example["wire"])
        sent = Packet(example["seq"], BY_NAME[example["message"]](**example["fields"]))
        for bit in range(8 * len(wire)):
            damaged = bytearray(wire)
            damaged[bit // 8] ^= 1 << bit % 8
            # The closing delimiter may be what was hit: the next one ends the frame then.
            found = Decoder().feed(bytes(damaged) + b"\0")
            assert [item for item in found if isinstance(item, Packet) and item != sent] == []
            assert found != [sent], (example["name"], bit)


@given(packets, st.sets(st.integers(0, MAX_WIRE_BYTES * 8), min_size=1, max_size=3))
def test_up_to_three_flipped_bits_of_a_body_are_always_detected(packet, bits):
    body = bytearray(unstuff(encode(packet.message, packet.seq)[:-1]))
    for bit in {bit % (8 * len(body)) for bit in bits}:
        body[bit // 8] ^= 1 << bit % 8
    (found,) = Decoder().feed(stuff(bytes(body)) + b"\0")
    assert isinstance(found, Fault)
    assert found.reason is FaultReason.CRC


@pytest.mark.parametrize(
    ("build", "word"),
    [
        (lambda: Set(0, FULL_LEVEL, MAX_ON_MS + 1), "250 ms"),
        (lambda: Set(0, FULL_LEVEL + 1, 1), "65535"),
        (lambda: Set(-1, 0, 1), "0..4294967295"),
        (lambda: Train(0, 0, MIN_PERIOD_US - 1, 1000, 1, FULL_LEVEL), "three flashes"),
        (lambda: Train(0, 0, 1_000_000, MAX_ON_MS * 1000 + 1, 1, FULL_LEVEL), "250000"),
        (lambda: Train(0, 0, 1_000_000, 0, 1, FULL_LEVEL), "on_us"),
        (lambda: Train(0, 0, 1_000_000, 1000, 0, FULL_LEVEL), "STOP"),
        (lambda: Pong(0, 0, 2, 1), "before"),
        (lambda: Stat(0, 0, 9, 0, 0, 0, 0, 0), "known are 0 IDLE"),
        (lambda: Event(0, 0, 2, 1, 0), "known are 0 OFF, 1 ON"),
        (lambda: Hello.from_host("x" * 25), "24 ASCII"),
        (lambda: Hello.from_host("naïve"), "24 ASCII"),
        (lambda: encode(Stop(), 65536), "65535"),
    ],
)
def test_a_message_beyond_a_limit_cannot_be_built(build, word):
    with pytest.raises(ProtocolError, match=word):
        build()


def test_the_shortest_period_keeps_the_rate():
    assert 1_000_000 / MIN_PERIOD_US <= MAX_RATE_HZ < 1_000_000 / (MIN_PERIOD_US - 1)


def test_the_page_names_every_message_field_and_the_limits():
    page = (PACKAGE / "PROTOCOL.md").read_text()
    for cls in MESSAGE_TYPES.values():
        assert f"{cls.__name__.upper()} 0x{cls.TYPE:02x}" in page
        for field in fields(cls):
            assert f"`{field.name}`" in page, f"{cls.__name__}.{field.name}"
    for value in ("250 ms", "3 flashes", "1.5 s", f"0x{schema_crc():04x}", f"{MIN_PERIOD_US:,}"):
        assert value in page


def test_a_message_is_the_same_whoever_made_it():
    assert issubclass(Ping, Message)
    assert Ping.unpack(Ping(5).pack()) == Ping(5)
