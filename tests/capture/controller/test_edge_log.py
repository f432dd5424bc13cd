"""The flash's edges beside the frames, when a capture was killed."""

from pathlib import Path

import pytest

from capture.controller.edge_log import EdgeLog, drop_edges_after, read_edges
from capture.devices.flash import FlashEdge
from capture.errors import SessionError


def edge(time_s):
    return FlashEdge(time_s=time_s, sigma_s=1e-4, on=True, pulse=int(time_s))


def test_edges_after_the_last_frame_and_a_torn_line_do_not_get_into_the_next_part(tmp_path):
    log = EdgeLog(tmp_path)
    log.append([edge(1.0), edge(2.0), edge(3.0)])
    log.close()
    with log.path.open("a") as file:
        file.write('{"time_s": 4.0, "sig')
    assert drop_edges_after(tmp_path, 2.5) == [edge(1.0), edge(2.0)]
    log = EdgeLog(tmp_path)
    log.append([edge(5.0)])
    log.close()
    assert read_edges(tmp_path) == [edge(1.0), edge(2.0), edge(5.0)]


def test_a_session_without_edges_has_none_to_drop(tmp_path):
    assert drop_edges_after(tmp_path, 1.0) == []
    assert list(tmp_path.iterdir()) == []


def test_a_spoilt_line_is_named(tmp_path):
    (tmp_path / "flash.jsonl").write_text("nonsense\n{}\n")
    with pytest.raises(SessionError, match="line 1 is no edge"):
        drop_edges_after(tmp_path, 1.0)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="only Linux has a disk that is always full")
def test_on_a_full_disk_it_says_so_once(tmp_path):
    (tmp_path / "flash.jsonl").symlink_to("/dev/full")
    log = EdgeLog(tmp_path)
    with pytest.raises(SessionError, match="No space left"):
        log.append([edge(1.0)])
    log.close()
