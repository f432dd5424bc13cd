"""The numbers of a lens by name, and which of them a distortion model has; `calib.lens.projection` has the
formulas.
"""

#: Names of the entries of a `lens` vector.
LENS_NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
#: Distortion models in the order of their number of terms: name -> terms.
LENS_MODELS: dict[str, tuple[str, ...]] = {
    "none": (),
    "k1": ("k1",),
    "k1k2": ("k1", "k2"),
    "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "k1k2p1p2k3": ("k1", "k2", "p1", "p2", "k3"),
}
