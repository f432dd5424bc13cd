"""From two devices to a session: the controller of a capture.

config.py       what is asked for
run.py          the capture, from the locked camera to the tagged session
looking.py      each frame is looked at once: for the tags, for what is shown, for what stops a capture
time_axis.py    stamps of the camera and edges of the flash on one axis
stop_rules.py   when a capture stops by itself, and the sentence that it says
frame_sink.py   frames on their way to the disk
edge_log.py     flash.jsonl, the flash's edges beside the frames
tags.py         which frames keep their pictures
interrupts.py   Ctrl-C and its kin
"""
