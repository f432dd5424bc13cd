"""The C code against the golden vectors that the Python codec has, and against that codec itself."""

import json
import subprocess
from dataclasses import astuple
from pathlib import Path
from random import Random

import pytest

import firmware_protocol
from firmware_protocol import MESSAGE_TYPES, Decoder, Packet, encode, limits
from firmware_protocol.cobs import stuff, unstuff
from firmware_protocol.crc import crc16_mcrf4xx
from firmware_protocol.errors import ProtocolError
from firmware_protocol.messages import Capability, ErrorCode, State, schema_crc

VECTORS = json.loads((Path(firmware_protocol.__file__).parent / "vectors.json").read_text())
BY_NAME = {cls.__name__.upper(): cls for cls in MESSAGE_TYPES.values()}


class Golden:
    """The test program of the host build: a line in, lines out."""

    def __init__(self, program, environment):
        self.process = subprocess.Popen(
            [program],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            bufsize=1,
            env=environment,
        )

    def ask(self, *words):
        self.process.stdin.write(" ".join(map(str, words)) + "\n")
        return self.process.stdout.readline().strip()

    def ask_list(self, *words):
        lines = [self.ask(*words)]
        while lines[-1] != "end":
            assert lines[-1], "the test program failed"
            lines.append(self.process.stdout.readline().strip())
        return lines[:-1]

    def decode(self, wire):
        return self.ask_list("decode", wire.hex() or "-")


@pytest.fixture(scope="module")
def golden(host_build, sanitizer_environment):
    golden = Golden(host_build / "golden", sanitizer_environment)
    yield golden
    golden.process.stdin.close()
    golden.process.stdout.close()
    assert golden.process.wait(timeout=5) == 0


def spelled(packet):
    """A packet or fault of the Python codec as the C program prints it."""
    if not isinstance(packet, Packet):
        return f"fault {packet.reason.value} {'-' if packet.seq is None else packet.seq}"
    values = (
        (value.encode().hex() or "-") if isinstance(value, str) else str(value)
        for value in astuple(packet.message)
    )
    return " ".join(["packet", str(packet.seq), type(packet.message).__name__.upper(), *values])


def test_the_constants_have_the_same_names_and_values(golden):
    constants = {name: int(value) for name, value in (line.split() for line in golden.ask_list("constants"))}
    assert constants.pop("SCHEMA_CRC") == schema_crc()
    for prefix, members in (("STATE", State), ("CAPABILITY", Capability), ("ERROR", ErrorCode)):
        for member in members:
            assert constants.pop(f"{prefix}_{member.name}") == member.value
    for name in [name for name in vars(limits) if name.isupper()]:
        assert constants.pop(name) == getattr(limits, name)
    assert constants == {}


def test_the_layouts_are_the_same(golden):
    assert golden.ask_list("schema") == VECTORS["schema"]


@pytest.mark.parametrize("example", VECTORS["crc16_mcrf4xx"], ids=lambda example: example["data"] or "empty")
def test_golden_checksums_in_c(golden, example):
    assert int(golden.ask("crc", example["data"] or "-")) == example["crc"]


@pytest.mark.parametrize("example", VECTORS["cobs"], ids=lambda example: example["data"][:16] or "empty")
def test_golden_stuffing_in_c(golden, example):
    assert golden.ask("stuff", example["data"] or "-") == example["stuffed"]
    assert golden.ask("unstuff", example["stuffed"]) == example["data"]


@pytest.mark.parametrize("example", VECTORS["frames"], ids=lambda example: example["name"])
def test_golden_frames_in_c(golden, example):
    wire = bytes.fromhex(example["wire"])
    packet = Packet(example["seq"], BY_NAME[example["message"]](**example["fields"]))
    _, seq, *words = spelled(packet).split()
    assert golden.ask("encode", seq, *words) == example["wire"]
    assert golden.decode(wire) == [spelled(packet)]


@pytest.mark.parametrize("example", VECTORS["faults"], ids=lambda example: example["name"])
def test_golden_faults_in_c(golden, example):
    seq = "-" if example["seq"] is None else example["seq"]
    assert golden.decode(bytes.fromhex(example["wire"])) == [f"fault {example['fault']} {seq}"]


def test_both_sides_agree_on_damaged_streams(golden):
    """Byte for byte: what one side takes for a packet or a fault, the other does, after any damage."""
    random = Random(1)
    frames = [bytes.fromhex(example["wire"]) for example in VECTORS["frames"] + VECTORS["faults"]]
    for _ in range(1500):
        stream = bytearray(b"".join(random.choices(frames, k=3)))
        for _ in range(random.randrange(4)):
            where = random.randrange(len(stream))
            damage = random.randrange(4)
            if damage == 0:
                stream[where] ^= 1 << random.randrange(8)
            elif damage == 1:
                del stream[where : where + random.randrange(1, 20)]
            elif damage == 2:
                stream[where:where] = random.randbytes(random.randrange(1, 20))
            else:
                stream[where] = 0
            stream += b"\0"
        assert golden.decode(stream) == [spelled(item) for item in Decoder().feed(stream)]


def test_both_sides_agree_on_any_body_with_a_right_checksum(golden):
    """Types, lengths and values that damage would hardly ever produce."""
    random = Random(2)
    for _ in range(1500):
        number = random.choice([*MESSAGE_TYPES, *MESSAGE_TYPES, 0, 0x0A, 0xFF])
        cls = MESSAGE_TYPES.get(number)
        length = cls.payload_bytes() + random.choice([0] * 12 + [1, -1]) if cls else random.randrange(40)
        payload = bytes(random.choice([0, 0, 1, 3, 0x7F, 0xFF, random.randrange(256)]) for _ in range(length))
        body = bytes([random.choice([1] * 12 + [0, 2]), number]) + random.randbytes(2) + payload
        wire = stuff(body + crc16_mcrf4xx(body).to_bytes(2, "little")) + b"\0"
        (found,) = Decoder().feed(wire)
        assert golden.decode(wire) == [spelled(found)]
        if isinstance(found, Packet):
            assert encode(found.message, found.seq) == wire
            assert golden.ask("encode", *spelled(found).split()[1:]) == wire.hex()


def test_both_sides_stuff_and_unstuff_any_bytes_alike(golden):
    random = Random(3)
    for _ in range(600):
        data = bytes(
            random.choice([0, 1, 255, random.randrange(256)]) for _ in range(random.randrange(1, 80))
        )
        data *= random.choice([1, 1, 1, 9])
        assert golden.ask("stuff", data.hex()) == stuff(data).hex()
        try:
            restored = unstuff(data).hex()
        except ProtocolError:
            restored = "bad"
        assert golden.ask("unstuff", data.hex()) == restored
