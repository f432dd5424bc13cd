"""Light on the sitter, per vertex: the room's, the flash's, a point's and an environment's; then pixels.

    L = albedo * (room irradiance / pi) + gloss of the room
      + F * (C_flash / d^2) * max(0, <n, l>) * visible * (albedo + gloss lobe)

Diffuse light is the fit's own model (Sevastopolsky et al. 2020, eqs. 1-7); gloss, cast shadows and their
penumbrae are what the fit does not know. Vertices lie about one pixel apart, so interpolated vertex radiance
is as sharp as the picture.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from capture.cameras import Camera
from capture.sim.bust import Bust
from capture.sim.environment import Environment, look_up
from capture.sim.rasterize import Raster
from capture.sim.visibility import point_visibility

_SKIN_EXPONENT = 22.0  # Blinn-Phong lobe of skin, about 17 degrees wide at half height
_WET_EXPONENT = 900.0
_STRAND_EXPONENT = 40.0
_TURNED_AWAY = -0.25  # cosine; vertices just behind the outline still colour triangles in front of it
# (a ribbon's edges are bent away from its face: theirs may be lower by 0.5)


@dataclass(frozen=True, eq=False)
class Layer:
    """One light's picture of the sitter.

    Attributes:
        radiance: [H, W, 3] linear, premultiplied by coverage.
        coverage: [H, W] 0..1.
    """

    radiance: np.ndarray
    coverage: np.ndarray


def facing_vertices(bust: Bust, eye: np.ndarray) -> np.ndarray:
    """Indices [C] of the vertices that a viewer at `eye` [3] may see: not turned away."""
    to_eye = eye.astype(np.float32) - bust.vertices
    length = np.sqrt(np.einsum("vc,vc->v", to_eye, to_eye))
    cosine = np.einsum("vc,vc->v", to_eye, bust.normals) / length
    cosine[bust.strand_start :] += 0.5
    return np.nonzero(cosine > _TURNED_AWAY)[0]


def environment_diffuse(
    bust: Bust, environment: Environment, passed: np.ndarray, turn: np.ndarray | None = None
) -> np.ndarray:
    """Diffuse radiance [V, 3] under a distant light of which the share `passed` [V, 3] arrives.

    Args:
        bust: the sitter.
        environment: the light.
        passed: see `BroadShadows`.
        turn: [3, 3] from the sitter's axes to the environment's; None = they are the same.
    """
    return bust.albedo * look_up(environment.diffuse, _turned(bust.normals, turn)) * passed


def environment_gloss(
    bust: Bust,
    environment: Environment,
    passed: np.ndarray,
    eye: np.ndarray,
    chosen: np.ndarray,
    turn: np.ndarray | None = None,
) -> np.ndarray:
    """Mirrored light [C, 3] of the chosen vertices [C] towards a viewer at `eye` [3], sitter's axes."""
    normals = bust.normals[chosen]
    to_eye = _unit(eye.astype(np.float32) - bust.vertices[chosen])
    cosine = np.einsum("vc,vc->v", to_eye, normals)[:, None]
    mirrored = _turned(2.0 * cosine * normals - to_eye, turn)
    light = look_up(environment.mirrored, mirrored)
    wet = bust.wet[chosen]
    light[wet] = look_up(environment.mirrored_wet, mirrored[wet])
    fresnel = 1.0 + 4.0 * np.clip(1.0 - cosine, 0.0, 1.0) ** 5
    fresnel[chosen >= bust.strand_start] = 1.0
    return light * fresnel * bust.gloss[chosen, None] * passed[chosen]


def _turned(directions: np.ndarray, turn: np.ndarray | None) -> np.ndarray:
    return directions if turn is None else directions @ turn.T.astype(np.float32)


def point_light(
    bust: Bust, position: np.ndarray, colour: np.ndarray, chosen: np.ndarray, eye: np.ndarray | None
) -> np.ndarray:
    """Radiance [C, 3] of the chosen vertices under a point light with cast shadows.

    Args:
        bust: the sitter.
        position: [3] of the light, world, metres.
        colour: [3] C: a Lambertian surface sends albedo * C / d^2 * cosine.
        chosen: [C] vertex indices.
        eye: [3] of the viewer, for gloss; None = diffuse only.
    """
    normals = bust.normals[chosen]
    ray = position.astype(np.float32) - bust.vertices[chosen]
    square = np.einsum("vc,vc->v", ray, ray)
    to_light = ray / np.sqrt(square)[:, None]
    cosine = np.maximum(np.einsum("vc,vc->v", to_light, normals), 0.0)
    arriving = cosine / square * point_visibility(bust, position, chosen)
    reflected = bust.albedo[chosen]
    if eye is not None:
        half = _unit(to_light + _unit(eye.astype(np.float32) - bust.vertices[chosen]))
        reflected = reflected + (bust.gloss[chosen] * _lobe(bust, chosen, normals, half))[:, None]
    return reflected * arriving[:, None] * colour.astype(np.float32)


def _lobe(bust: Bust, chosen: np.ndarray, normals: np.ndarray, half: np.ndarray) -> np.ndarray:
    """Blinn-Phong lobe [C], energy-conserving, times pi; around the strand for hair (Kajiya-Kay 1989)."""
    exponent = np.where(bust.wet[chosen], np.float32(_WET_EXPONENT), np.float32(_SKIN_EXPONENT))
    cosine = np.clip(np.einsum("vc,vc->v", half, normals), 1e-6, 1.0)
    strand = chosen >= bust.strand_start
    if strand.any():
        along = np.einsum("vc,vc->v", half[strand], bust.tangents[chosen[strand]])
        cosine[strand] = np.sqrt(np.clip(1.0 - along * along, 1e-6, 1.0))
        exponent[strand] = _STRAND_EXPONENT
    return (exponent + 8.0) / 8.0 * np.exp(exponent * np.log(cosine))


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.sqrt(np.einsum("vc,vc->v", vectors, vectors))[:, None]


def draw_vertices(bust: Bust, camera: Camera, attributes: np.ndarray) -> Raster:
    """Vertex attributes [V, 3] seen by a camera, one sample a pixel."""
    raster = Raster.empty(camera)
    raster.draw(bust.vertices, bust.triangles, attributes)
    return raster


def draw_layer(bust: Bust, camera: Camera, radiance: np.ndarray, supersampling: int) -> Layer:
    """Vertex radiance [V, 3] to pixels, averaged over supersampling x supersampling samples a pixel."""
    raster = draw_vertices(bust, camera.scaled(supersampling), radiance)
    size = (camera.width, camera.height)
    coverage = cv2.resize(raster.covered.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return Layer(cv2.resize(raster.values, size, interpolation=cv2.INTER_AREA), coverage)
