"""A decoder and a refinement of the plainest kind: maps of the splats, darker by a factor a point."""

from dataclasses import dataclass, replace

import torch

from relight.decoder import Decoder
from relight.maps import splat_maps


class PlainDecoder(Decoder):
    """Albedo times `dark`, the mean of one number a point; its other maps are the splatted ones."""

    kind = "plain"

    def __init__(self, factor, dark):
        self.factor, self.dark = factor, dark

    def decode(self, portrait, camera):
        maps = splat_maps(portrait, camera)
        return replace(maps, albedo=maps.albedo * self.factor * self.dark.mean())

    def settings(self):
        return {"factor": self.factor}

    def tensors(self):
        return {"dark": self.dark}

    @classmethod
    def restored(cls, settings, tensors):
        if tensors["dark"].ndim != 1:
            raise ValueError("dark is not one number a point")
        return cls(float(settings["factor"]), tensors["dark"])

    def to(self, device):
        return PlainDecoder(self.factor, self.dark.to(device))

    def subset(self, keep):
        return PlainDecoder(self.factor, self.dark[keep])

    def transformed(self, similarity):
        return self


@dataclass(frozen=True)
class PlainConfig:
    factor: float = 1.0


def refine(scene, solved, *, config, seconds, face, checkpoint, seed, progress):
    """Leaves what it was given in the portrait's info, and how often it was run in its checkpoint."""
    progress("refine", 1.0)
    count = checkpoint / "count"
    count.write_text(str(int(count.read_text()) + 1 if count.exists() else 1))
    info = {**solved.info, "seconds": seconds, "seed": seed, "runs": int(count.read_text())}
    decoder = PlainDecoder(config.factor, torch.ones(len(solved.points), device=scene.device))
    return replace(solved, decoder=decoder, info=info | {"warnings": ["Refined."]})
