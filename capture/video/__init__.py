"""Video files through PyAV: read by their own time stamps and colour tags, written as phones write them.

Pictures stay in sensor orientation: nothing here rotates. `rotation_deg` is the clockwise turn that makes the
picture upright, as Android's orientation hint (90 for a phone held upright). FFmpeg counts the other way.
"""

from capture.video.reader import DecodedFrame, VideoInfo, decode_video, probe_video
from capture.video.writer import VideoWriter

__all__ = ["DecodedFrame", "VideoInfo", "VideoWriter", "decode_video", "probe_video"]
