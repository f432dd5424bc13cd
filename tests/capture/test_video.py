"""Video files: times, tags and pixels survive writing and reading; damaged files end in one sentence."""

from collections.abc import Callable
from datetime import UTC, datetime
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from capture.errors import SourceError
from capture.video import VideoWriter, decode_video, probe_video
from capture.video import reader as reader_module
from capture.video.colour import (
    MATRIX_CODES,
    RANGE_CODES,
    VideoColour,
    colour_of_frame,
    fill_frame,
    full_scale_planes,
    luma_levels,
    plane,
    rgb_from_frame,
)

WIDTH, HEIGHT = 96, 64
Damage = Callable[[bytes], st.SearchStrategy[bytes]]


def reference_rgb(
    planes: tuple[NDArray[np.float64], ...], matrix: str, color_range: str, bits: int
) -> NDArray[np.float64]:
    """R'G'B' 0..1 of full-resolution planes, from the inverse of the matrix that BT.709-6 3.2 defines."""
    red, blue = {"bt601": (0.299, 0.114), "bt709": (0.2126, 0.0722), "bt2020": (0.2627, 0.0593)}[matrix]
    luma = np.array([red, 1 - red - blue, blue])
    forward = np.stack(
        [
            luma,
            (np.array([0, 0, 1]) - luma) / (2 * (1 - blue)),
            (np.array([1, 0, 0]) - luma) / (2 * (1 - red)),
        ]
    )
    scale = 2.0 ** (bits - 8)
    spans = np.array([219, 224, 224]) * scale if color_range == "limited" else np.full(3, 2.0**bits - 1)
    zeros = np.array([16 if color_range == "limited" else 0, 128, 128]) * scale
    yuv = (np.stack(planes, axis=-1) - zeros) / spans
    return np.clip(yuv @ np.linalg.inv(forward).T, 0, 1)


def block_frame(bits: int, seed: int) -> tuple[av.VideoFrame, tuple[NDArray[np.float64], ...]]:
    """A frame of 16 px blocks of one chroma under random luma, and its planes in full resolution."""
    rng = np.random.default_rng(seed)
    scale = 1 << (bits - 8)
    frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p" if bits == 8 else "yuv420p10le")
    luma = rng.integers(0, 256 * scale, (HEIGHT, WIDTH))
    blue, red = (
        np.kron(rng.integers(60 * scale, 200 * scale, (HEIGHT // 16, WIDTH // 16)), np.ones((8, 8), int))
        for _ in range(2)
    )
    for index, values in enumerate((luma, blue, red)):
        plane(frame, index)[:] = values
    doubled = (np.kron(values, np.ones((2, 2))) for values in (blue, red))
    return frame, (luma.astype(float), *doubled)


def blocks(seed: int = 0) -> NDArray[np.uint8]:
    """A picture of 16 px blocks of random colours, which 4:2:0 keeps in their middle."""
    colours = np.random.default_rng(seed).integers(20, 236, (HEIGHT // 16, WIDTH // 16, 3))
    return np.kron(colours, np.ones((16, 16, 1))).astype(np.uint8)


def block_middles() -> tuple[slice, slice]:
    return slice(7, None, 16), slice(7, None, 16)


def write(path: Path, times: list[float], **options: object) -> Path:
    with VideoWriter(path, WIDTH, HEIGHT, **options) as writer:  # type: ignore[arg-type]
        for seed, time in enumerate(times):
            writer.write(blocks(seed), time)
    return path


@pytest.fixture(scope="module")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames of H.264 with location and creation time."""
    return write(
        tmp_path_factory.mktemp("video") / "VID_20261102_101530.mp4",
        [0.04 * k for k in range(12)],
        creation_time=datetime(2026, 11, 2, 9, 15, 50, tzinfo=UTC),
        location="+52.5200+013.4050/",
    )


# ---------------------------------------------------------------- colour


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("color_range", ["limited", "full"])
@pytest.mark.parametrize("matrix", ["bt601", "bt709", "bt2020"])
def test_rgb_is_the_correctly_rounded_inverse_of_the_standards_matrix(
    matrix: str, color_range: str, bits: int
) -> None:
    frame, planes = block_frame(bits, seed=bits)
    colour = VideoColour(matrix, color_range, "rec709", matrix)
    rgb = rgb_from_frame(frame, colour)
    assert rgb.dtype == (np.uint8 if bits == 8 else np.uint16)
    largest = np.iinfo(rgb.dtype).max
    error = np.abs(rgb - largest * reference_rgb(planes, matrix, color_range, bits))
    # Chroma is constant inside a block: 3 px from its edge no interpolation reaches over.
    inside = np.kron(np.ones((HEIGHT // 16, WIDTH // 16)), np.pad(np.ones((8, 8)), 4)).astype(bool)
    # Half a code is rounding. swscale computes with 14-bit coefficients: up to 0.02 codes on top. The
    # float32 path of deep video loses 2^-23 of 65535 codes in each of about four operations.
    assert error[inside].max() < (0.52 if bits == 8 else 0.55)


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("color_range", ["limited", "full"])
@pytest.mark.parametrize("matrix", ["bt601", "bt709", "bt2020"])
def test_writing_a_colour_and_reading_it_back_gives_the_colour(
    matrix: str, color_range: str, bits: int
) -> None:
    frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p" if bits == 8 else "yuv420p10le")
    fill_frame(frame, blocks(), matrix, color_range)
    rgb = rgb_from_frame(frame, VideoColour(matrix, color_range, "rec709", matrix))
    error = np.abs(rgb / np.iinfo(rgb.dtype).max * 255 - blocks())[block_middles()]
    # Y', Cb and Cr are each rounded to half a code; through the inverse matrix that is at most
    # (0.5 + 0.5 * 1.88) * 255/219 = 1.7 codes of R'G'B', and a quarter of it with two more bits.
    assert error.max() <= (1.7 + 0.5 if bits == 8 else 0.43)


def test_pure_colours_in_full_range_do_not_wrap_around() -> None:
    for colour in ([0, 0, 255], [255, 0, 0], [255, 255, 255], [0, 0, 0]):
        frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
        fill_frame(frame, np.full((HEIGHT, WIDTH, 3), colour, np.uint8), "bt709", "full")
        rgb = rgb_from_frame(frame, VideoColour("bt709", "full", "rec709", "bt709"))
        # Blue and red lose one chroma code at the end of the scale: 1.86 codes of R'G'B'.
        assert np.abs(rgb.astype(int) - colour).max() <= 2


@pytest.mark.parametrize("bits", [8, 10])
@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_chroma_stays_in_its_place(codec: str, bits: int, tmp_path: Path) -> None:
    columns, rows = np.arange(WIDTH), np.arange(HEIGHT)
    ramp = np.full((HEIGHT, WIDTH, 3), 100, np.uint8)
    ramp[..., 0] = (60 + columns)[None, :]
    ramp[..., 2] = (60 + 2 * rows)[:, None]
    with VideoWriter(
        tmp_path / "a.mp4", WIDTH, HEIGHT, codec=codec, bits=bits, crf=0, color_range="full"
    ) as writer:
        writer.write(ramp, 0.0)
    info = probe_video(tmp_path / "a.mp4")
    rgb = rgb_from_frame(next(decode_video(info)).picture, info.colour)
    error = (rgb / np.iinfo(rgb.dtype).max * 255 - ramp)[8:-8, 8:-8]
    # Wrong siting would shift by half a pixel: 0.5 codes on the red ramp. The mean of 4000 rounded pixels is
    # good to 0.01; the encoder at its best quality adds a few hundredths.
    assert np.abs(error.mean(axis=(0, 1))).max() < 0.1


def test_tags_written_are_the_tags_read(tmp_path: Path) -> None:
    for codec in ("h264", "hevc"):
        for matrix in MATRIX_CODES:
            for color_range in RANGE_CODES:
                for transfer in ("rec709", "srgb", "gamma:2.2"):
                    tags = {"matrix": matrix, "color_range": color_range, "transfer": transfer}
                    info = probe_video(write(tmp_path / "a.mp4", [0.0], codec=codec, **tags))
                    assert info.colour == VideoColour(matrix, color_range, transfer, matrix)
                    assert info.codec == codec


def test_decoded_pictures_have_the_written_colours_by_their_own_tags(tmp_path: Path) -> None:
    for matrix, color_range in (("bt601", "full"), ("bt709", "limited"), ("bt2020", "limited")):
        path = write(tmp_path / "a.mp4", [0.0], matrix=matrix, color_range=color_range, crf=1)
        info = probe_video(path)
        rgb = rgb_from_frame(next(decode_video(info)).picture, info.colour)
        error = np.abs(rgb.astype(int) - blocks())[block_middles()]
        # Rounding of Y'CbCr and the encoder; another matrix or range would be off by 5 to 20 codes in the
        # mean.
        assert error.mean() < 1.5


@pytest.mark.parametrize(
    ("size", "matrix"), [((640, 480), "BT.601"), ((1280, 720), "BT.709"), ((720, 1280), "BT.709")]
)
def test_untagged_video_is_decided_by_its_size_and_says_so(size: tuple[int, int], matrix: str) -> None:
    frame = av.VideoFrame(*size, "yuv420p")
    colour = colour_of_frame(frame, "a.mp4")
    assert colour.matrix == matrix.lower().replace(".", "")
    assert colour.color_range == "limited"
    assert colour.transfer == "rec709"
    assert [matrix in colour.warnings[0], len(colour.warnings)] == [True, 3]


def test_a_missing_matrix_tag_is_taken_from_the_primaries() -> None:
    frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
    frame.color_primaries = 9
    assert colour_of_frame(frame, "a.mp4").matrix == "bt2020"


@pytest.mark.parametrize("transfer", ["pq", "hlg"])
def test_hdr_video_is_refused_with_what_to_do(transfer: str, tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4", [0.0], codec="hevc", bits=10, matrix="bt2020", transfer=transfer)
    with pytest.raises(SourceError, match=r"HDR .*switch HDR off"):
        probe_video(path)


def test_a_matrix_that_no_phone_uses_is_refused() -> None:
    frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p")
    frame.colorspace = 14
    with pytest.raises(SourceError, match="matrix 14"):
        colour_of_frame(frame, "a.mp4")


def test_pixel_formats_other_than_planar_yuv_are_refused() -> None:
    for kind in ("rgb24", "gray", "nv12", "yuyv422"):
        with pytest.raises(SourceError, match=kind):
            colour_of_frame(av.VideoFrame(WIDTH, HEIGHT, kind), "a.mp4")


def test_planes_for_tagging_fill_their_type_and_the_levels_say_how() -> None:
    for bits, kind in ((8, np.uint8), (10, np.uint16)):
        for color_range in RANGE_CODES:
            colour = VideoColour("bt709", color_range, "rec709", "bt709")
            frame = av.VideoFrame(WIDTH, HEIGHT, "yuv420p" if bits == 8 else "yuv420p10le")
            fill_frame(frame, np.full((HEIGHT, WIDTH, 3), 255, np.uint8), "bt709", color_range)
            luma, blue, _ = full_scale_planes(frame)
            black, white = luma_levels(colour, bits)
            assert luma.dtype == kind
            assert luma[0, 0] == white
            assert black < 0.1 * white
            assert blue[0, 0] == (int(np.iinfo(kind).max) + 1) // 2


# ---------------------------------------------------------------- times and header


@pytest.mark.parametrize("codec", ["h264", "hevc"])
def test_variable_frame_times_and_the_start_offset_are_kept_to_the_tick(codec: str, tmp_path: Path) -> None:
    steps = np.random.default_rng(3).uniform(0.02, 0.08, 20)
    times = (0.35 + np.cumsum(steps)).tolist()
    info = probe_video(write(tmp_path / "a.mp4", times, codec=codec))
    read = [frame.pts_s for frame in decode_video(info)]
    # Half a tick of 1/90000 s is the rounding of the container.
    np.testing.assert_allclose(read, times, atol=0.51 / 90_000)
    assert info.start_s == read[0]
    assert info.header_frames == 20


@pytest.mark.parametrize("rotation", [0, 90, 180, 270])
def test_rotation_is_recorded_and_the_picture_is_left_as_it_is(rotation: int, tmp_path: Path) -> None:
    info = probe_video(write(tmp_path / "a.mp4", [0.0], rotation_deg=rotation, crf=1))
    assert info.rotation_deg == rotation
    assert (info.width, info.height) == (WIDTH, HEIGHT)
    rgb = rgb_from_frame(next(decode_video(info)).picture, info.colour)
    assert np.abs(rgb.astype(int) - blocks())[block_middles()].mean() < 1.5


def test_a_phone_held_upright_writes_androids_matrix_for_90_degrees(tmp_path: Path) -> None:
    content = write(tmp_path / "a.mp4", [0.0], rotation_deg=90).read_bytes()
    header = content[content.index(b"tkhd") :]
    # ISO 14496-12, 8.3.2: the matrix a b u c d v x y w starts 40 bytes into the version 0 box's content.
    matrix = np.frombuffer(header[44 : 44 + 36], ">i4")
    assert matrix[[0, 1, 3, 4]].tolist() == [0, 0x10000, -0x10000, 0]


def test_the_same_frames_give_the_same_bytes(tmp_path: Path) -> None:
    for codec in ("h264", "hevc"):
        one = write(tmp_path / "one.mp4", [0.0, 0.1, 0.2], codec=codec).read_bytes()
        two = write(tmp_path / "two.mp4", [0.0, 0.1, 0.2], codec=codec).read_bytes()
        assert one == two


def test_creation_time_is_read_and_a_clock_that_was_never_set_is_not(clip: Path, tmp_path: Path) -> None:
    assert probe_video(clip).creation_time == datetime(2026, 11, 2, 9, 15, 50, tzinfo=UTC)
    never_set = write(tmp_path / "a.mp4", [0.0], creation_time=datetime(1970, 1, 1, tzinfo=UTC))
    assert probe_video(never_set).creation_time is None


def test_the_location_is_known_but_not_shown(clip: Path) -> None:
    info = probe_video(clip)
    assert info.location == "+52.5200+013.4050/"
    assert "52.52" not in repr(info)


def test_frames_without_times_get_the_mean_interval_and_a_sentence(
    clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = reader_module._decoded_packets

    def without_times(*arguments: object) -> object:
        for broken, frames in plain(*arguments):  # type: ignore[arg-type]
            for frame in frames:
                frame.pts = None
                frame.dts = None
            yield broken, frames

    info = probe_video(clip)
    monkeypatch.setattr(reader_module, "_decoded_packets", without_times)
    problems: list[str] = []
    times = [frame.pts_s for frame in decode_video(info, problems)]
    np.testing.assert_allclose(np.diff(times), info.frame_interval_s)
    assert "no time for 12 frames" in problems[0]


def test_times_that_stand_still_are_put_in_order_and_named(
    clip: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plain = reader_module._decoded_packets

    def standing(*arguments: object) -> object:
        for broken, frames in plain(*arguments):  # type: ignore[arg-type]
            for frame in frames:
                frame.pts = min(frame.pts, 18_000)
            yield broken, frames

    info = probe_video(clip)
    monkeypatch.setattr(reader_module, "_decoded_packets", standing)
    problems: list[str] = []
    times = [frame.pts_s for frame in decode_video(info, problems)]
    assert np.all(np.diff(times) > 0)
    assert "not later than the one before" in problems[0]


# ---------------------------------------------------------------- files that are not as they should be


@pytest.fixture
def streamable(clip: Path, tmp_path: Path) -> bytes:
    """The clip's content with its index before the pictures, so that the end can be cut off."""
    path = tmp_path / "streamable.mp4"
    with av.open(str(clip)) as source, av.open(str(path), "w", options={"movflags": "faststart"}) as target:
        stream = target.add_stream_from_template(source.streams.video[0])
        for packet in source.demux(source.streams.video[0]):
            if packet.dts is not None:
                packet.stream = stream
                target.mux(packet)
    return path.read_bytes()


def test_a_recording_without_its_index_is_told_apart(clip: Path, tmp_path: Path) -> None:
    content = clip.read_bytes()
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(content[: content.index(b"moov") - 4])
    with pytest.raises(SourceError, match=r"index \(moov\) is missing"):
        probe_video(cut)


def test_of_a_file_that_is_cut_off_the_beginning_is_read_and_the_loss_named(
    streamable: bytes, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(streamable[: len(streamable) // 2])
    problems: list[str] = []
    frames = sum(1 for _ in decode_video(probe_video(cut), problems))
    assert 0 < frames < 12
    assert f"{frames} of its 12 frames could be read" in problems[0]


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        (b"", "it is empty"),
        (b"hello world\n" * 100, "it is no mp4"),
        (b"ffconcat version 1.0\nfile 'other.mp4'\n", "it is no mp4"),
        (b"#EXTM3U\n#EXTINF:1,\nhttp://example.org/a.ts\n", "it is no mp4"),
    ],
)
def test_other_files_are_refused_and_playlists_not_followed(
    content: bytes, sentence: str, tmp_path: Path
) -> None:
    path = tmp_path / "a.mp4"
    path.write_bytes(content)
    with pytest.raises(SourceError, match=sentence):
        probe_video(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    for path in (tmp_path / "none.mp4", tmp_path):
        with pytest.raises(SourceError, match="does not exist or is no file"):
            probe_video(path)


def test_sound_alone_is_no_video(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        for start in range(0, 8192, 1024):
            frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
            frame.rate, frame.pts, frame.time_base = 8000, start, Fraction(1, 8000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    with pytest.raises(SourceError, match=r"no video track .*audio"):
        probe_video(path)


def test_a_video_of_no_frames_is_refused(tmp_path: Path) -> None:
    VideoWriter(tmp_path / "a.mp4", WIDTH, HEIGHT).close()
    with pytest.raises(SourceError, match=r"no video track|no frame can be decoded|cannot be read"):
        probe_video(tmp_path / "a.mp4")


def test_a_picture_that_changes_its_size_is_refused(tmp_path: Path) -> None:
    content = b""
    for width in (WIDTH, 2 * WIDTH):
        path = tmp_path / f"{width}.ts"
        with av.open(str(path), "w") as container:
            stream = container.add_stream("libx264", rate=30, options={"bf": "0"})
            stream.width, stream.height = width, HEIGHT
            for _ in range(3):
                picture = av.VideoFrame.from_ndarray(np.zeros((HEIGHT, width, 3), np.uint8), "rgb24")
                container.mux(stream.encode(picture))
            container.mux(stream.encode(None))
        content += path.read_bytes()
    both = tmp_path / "both.ts"
    both.write_bytes(content)
    with pytest.raises(SourceError, match="changes its size"):
        for _ in decode_video(probe_video(both)):
            pass


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_read_in_part_or_refused(
    data: st.DataObject, streamable: bytes, damage: Damage, scratch: Path
) -> None:
    path = scratch / "damaged.mp4"
    path.write_bytes(data.draw(damage(streamable)))
    try:
        info = probe_video(path)
        times = [frame.pts_s for frame in decode_video(info, [])]
    except SourceError:
        return
    assert np.all(np.diff(times) > 0)


# ---------------------------------------------------------------- the writer's own checks


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("codec", "av1"),
        ("matrix", "bt470"),
        ("color_range", "tv"),
        ("transfer", "log:100"),
        ("rotation_deg", 45),
        ("bits", 12),
    ],
)
def test_unknown_choices_are_refused_with_the_known_ones(option: str, value: object, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"{option} is .* must be one of"):
        VideoWriter(tmp_path / "a.mp4", WIDTH, HEIGHT, **{option: value})  # type: ignore[arg-type]


def test_odd_sizes_naive_times_and_wrong_frames_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must be even"):
        VideoWriter(tmp_path / "a.mp4", 97, HEIGHT)
    with pytest.raises(ValueError, match="time zone"):
        VideoWriter(tmp_path / "a.mp4", WIDTH, HEIGHT, creation_time=datetime(2026, 1, 1))
    with pytest.raises(SourceError, match="cannot be written"):
        VideoWriter(tmp_path / "none" / "a.mp4", WIDTH, HEIGHT)
    writer = VideoWriter(tmp_path / "a.mp4", WIDTH, HEIGHT)
    writer.write(blocks(), 0.0)
    with pytest.raises(ValueError, match="does not fit"):
        writer.write(blocks()[1:], 0.1)
    with pytest.raises(ValueError, match="not later"):
        writer.write(blocks(), 0.0)
    writer.close()


def test_a_writer_that_fails_leaves_no_file(tmp_path: Path) -> None:
    def fail() -> None:
        with VideoWriter(tmp_path / "a.mp4", WIDTH, HEIGHT) as writer:
            writer.write(blocks(), 0.0)
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert list(tmp_path.iterdir()) == []
