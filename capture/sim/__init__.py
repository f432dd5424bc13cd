"""The simulated rig: a person in a room, filmed by a phone whose flash blinks, with the truth beside it.

It is the embedded default, for trying everything without hardware and for tests with a known answer. It has
its own geometry, its own light transport and its own rasteriser (OpenCV's), so that the fit is never tested
on itself.

Modelled: a sculpted head with eyes, lips, ears, eyebrows, strands of hair with a soft outline, skin with
freckles, pores and redness, a shirt; several subjects by seed, bald and glossy-skinned ones too. Diffuse and
glossy reflection of a furnished room (with the sitter's own broad shadows), of an off-axis flash (1/d^2,
cosine, cast shadows, gloss) and of novel lights. A hand-held path with sway and tremor. A lamp with a timer
of fixed delay, rise, fall and droop. A rolling shutter that catches pulses in part of the rows. Shot and
read noise, black level, conversion, clipping, transfer curve; H.264 or HEVC with a phone's colour tags and
rotation. On request lost frames, drift of exposure and white balance, mains flicker, missed pulses, a lamp
that always burns; a chair that turns, a nod, swaying; frames blurred by a jerk of the hand; bare walls,
printed markers.

Not modelled: light that bounces between parts of the sitter or goes through skin; a neck that bends, a face
that moves (the sitter is one rigid piece); a shadow of the sitter on the room's walls; blur by the path's own
motion, and the bending of moving edges by the rolling shutter (each frame has one pose); lens distortion,
vignetting, flare, focus hunting; sharpening and noise reduction of the phone; sound. The room's light is
taken as distant: the same over the whole head but for shadows.

Modules in the order in which a photon meets them: lamp and room, bust (head, eyes, skin, hair), shading,
head_motion, camera_path, shake, sensor, rig, truth; `simulate` writes the folders.
"""

from capture.sim.config import RigConfig
from capture.sim.rig import Rig
from capture.sim.simulate import simulate_posed_set, simulate_video
from capture.sim.subject import Subject

__all__ = ["Rig", "RigConfig", "Subject", "simulate_posed_set", "simulate_video"]
