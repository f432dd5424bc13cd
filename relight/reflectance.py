"""How the subject's surface reflects light beyond Lambert, with three numbers.

With the lamp next to the lens, light and view direction are one and reflectance depends on a single angle:
c, the cosine between it and the normal. Two effects bend the curve away from Lambert's c on skin and most
else: the retro-reflection of rough surfaces towards grazing angles (Burley 2012, "Physically based shading
at Disney", section 5.3) and gloss at normal incidence (GGX, Walter et al. 2007). Per point, albedo and
normal would have to explain both; as three numbers of the whole subject they can be fitted from all points
and frames at once:

    L d^2 / C = albedo c (1 + retro (1 - c)^5)^2  +  f0 gloss(c)
    gloss(c) = alpha^2 c / (4 (c (1 - k) + k)^2 (c^2 (alpha^2 - 1) + 1)^2),    k = alpha / 2 (Schlick's G)

L is the radiance that a light of colour C adds from a distance d, in units in which a white Lambertian
surface facing it has L d^2 / C = 1: the pi of irradiance and the 1/pi of the BRDF have cancelled.
`Reflectance.response` is the same model for any directions of light and view.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch

GRAZING = 0.2
"""Cosine below which a flash observation is not used: there the model, the pose and the depth err most."""

_RETROS = (0.0, 0.25, 0.5, 0.75, 1.0)
_ALPHAS = (0.08, 0.12, 0.18, 0.25, 0.35, 0.5)
_STEP, _FACTOR, _FINER = 0.25, 1.4, (2, 4, 8)  # of the grid, and how much finer the search goes on
_SCALE = 0.02  # residual that counts as noise, for albedos of the order of one half
_ITERATIONS = 5


@dataclass(frozen=True)
class Reflectance:
    """Of the whole subject.

    Attributes:
        retro: Strength of retro-reflection at grazing angles; 0 = Lambert.
        alpha: GGX width, roughness squared.
        f0: Reflectance of the gloss at normal incidence, in units of the albedo's scale; 0 = matte.
    """

    retro: float = 0.0
    alpha: float = 0.25
    f0: float = 0.0

    def diffuse(self, cosine: torch.Tensor) -> torch.Tensor:
        """What multiplies the albedo, c (1 + retro (1 - c)^5)^2; 0 for c <= 0."""
        c = cosine.clamp(0.0, 1.0)
        return c * (1.0 + self.retro * (1.0 - c) ** 5) ** 2

    def gloss(self, cosine: torch.Tensor) -> torch.Tensor:
        """What the gloss adds to the diffuse part; 0 for c <= 0."""
        return self.f0 * gloss_lobe(cosine, self.alpha)

    def response(
        self,
        albedo: torch.Tensor,
        normals: torch.Tensor,
        to_light: torch.Tensor,
        to_view: torch.Tensor,
        gloss: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Radiance under a light of unit colour at unit distance, for any directions.

        For to_view = to_light it is `albedo * diffuse(c) + gloss(c)`. Away from there Burley's
        retro-reflection fades with the angle between light and view, and gloss is GGX with Schlick's
        Fresnel term.

        Args:
            albedo: [..., 3].
            normals: [..., 3], unit, or 0 where no surface is known: there the response is 0.
            to_light: [..., 3], unit.
            to_view: [..., 3], unit.
            gloss: [..., 1], factor on f0 of each point; by default 1.

        Returns:
            [..., 3], 0 where the light is behind the surface.
        """
        light = (normals * to_light).sum(dim=-1, keepdim=True).clamp(0.0, 1.0)
        view = (normals * to_view).sum(dim=-1, keepdim=True).clamp(0.0, 1.0)
        half = to_light + to_view
        # Opposite directions have no half vector; a vanishing one is none of the surface's either.
        half = half / torch.linalg.vector_norm(half, dim=-1, keepdim=True).clamp(min=1e-6)
        deviation = (half * to_light).sum(dim=-1, keepdim=True).clamp(0.0, 1.0)
        diffuse = light
        if self.retro > 0:
            grazing = (self.retro + 0.5) * deviation**2 - 0.5
            diffuse = light * (1.0 + grazing * (1.0 - light) ** 5) * (1.0 + grazing * (1.0 - view) ** 5)
        result = albedo * diffuse
        if self.f0 > 0:
            k, square = self.alpha / 2.0, self.alpha**2
            f0 = self.f0 if gloss is None else self.f0 * gloss
            # Schlick's term grows with the factor too: what has no gloss has none at any angle.
            fresnel = f0 + f0 / self.f0 * (1.0 - self.f0) * (1.0 - deviation) ** 5
            normal = (normals * half).sum(dim=-1, keepdim=True).clamp(0.0, 1.0)
            masking = 4.0 * (light * (1.0 - k) + k) * (view * (1.0 - k) + k)
            result = result + fresnel * square * light / (masking * (normal**2 * (square - 1.0) + 1.0) ** 2)
        return result


def gloss_lobe(cosine: torch.Tensor, alpha: float) -> torch.Tensor:
    """Gloss seen along the light's direction, for f0 = 1; 0 for c <= 0."""
    c = cosine.clamp(0.0, 1.0)
    k, square = alpha / 2.0, alpha * alpha
    return square * c / (4.0 * (c * (1.0 - k) + k) ** 2 * (c * c * (square - 1.0) + 1.0) ** 2)


def fit_reflectance(cosine: torch.Tensor, response: torch.Tensor, weight: torch.Tensor) -> Reflectance:
    """Fits the three numbers with the albedo of every point left free (variable projection, robust).

    Args:
        cosine: [K, P] of each flash frame and point.
        response: [K, P], flash-added radiance * d^2, scaled so that albedos are of the order of one half.
        weight: [K, P], 0 where there is no observation.

    Returns:
        The best of a grid over `retro` and `alpha` and of ever smaller steps from there (Hooke and Jeeves
        1961, "Direct search"); `f0` by least squares. Lambert if nothing was observed.
    """
    weight = weight * (cosine > GRAZING) * cosine.clamp(min=0.0)
    weight = weight * ((weight > 0).sum(dim=0) >= 3)  # with one or two frames an albedo explains everything
    total = float(weight.sum(dtype=torch.float64))
    if total <= 0:
        return Reflectance()

    @cache
    def fitted(retro: float, alpha: float) -> tuple[float, float]:
        """f0 and loss."""
        diffuse = Reflectance(retro).diffuse(cosine)
        return _fit_f0(diffuse, gloss_lobe(cosine, alpha), response, weight)

    def loss(pair: tuple[float, float]) -> float:
        return fitted(*pair)[1]

    best = min(((retro, alpha) for retro in _RETROS for alpha in _ALPHAS), key=loss)
    for fineness in _FINER:
        around = [best]
        while around:
            retro, alpha = best
            step, factor = _STEP / fineness, _FACTOR ** (1.0 / fineness)
            around = [(max(0.0, retro - step), alpha), (retro + step, alpha)]
            around += [(retro, alpha / factor), (retro, alpha * factor)]
            # A lobe wider than the grid's cannot be told from albedo any more.
            around = [p for p in around if p[0] <= _RETROS[-1] and _ALPHAS[0] <= p[1] <= _ALPHAS[-1]]
            around = [pair for pair in around if loss(pair) < loss(best)]
            best = min([best, *around], key=loss)
    return Reflectance(*best, fitted(*best)[0])


def _fit_f0(
    diffuse: torch.Tensor, lobe: torch.Tensor, response: torch.Tensor, weight: torch.Tensor
) -> tuple[float, float]:
    """Mean f0 >= 0 and the robust loss, with albedo and gloss of each point projected out of the problem.

    A subject is skin, hair and cloth: with one f0 for all of them the widths would be bent to fit the
    mixture.
    """
    along, square, left = _gloss_normal_equations(diffuse, lobe, response, weight)
    used = (square > 0) & (weight > 0).any(dim=0)
    f0 = max(0.0, float(along.sum(dtype=torch.float64) / square.sum(dtype=torch.float64).clamp(min=1e-12)))
    prior = float(square[used].median()) if bool(used.any()) else 1.0
    own = ((along + prior * f0) / (square + prior).clamp(min=1e-12)).clamp(min=0.0)
    residual = (left[0] - own * left[1]) / _SCALE
    loss = (weight * torch.log1p(residual**2)).sum(dtype=torch.float64) / weight.sum(dtype=torch.float64)
    return f0, float(loss)


def fit_local_gloss(
    cosine: torch.Tensor, response: torch.Tensor, weight: torch.Tensor, reflectance: Reflectance
) -> tuple[torch.Tensor, torch.Tensor]:
    """What each point says of its own f0: the two sides of its normal equation, to be pooled with neighbours.

    Args:
        cosine: [K, P].
        response: [K, P], scaled as for `fit_reflectance`.
        weight: [K, P].
        reflectance: Gives the curves.

    Returns:
        [P] right-hand sides and [P] squares; f0 of any group of points is the ratio of their sums.
    """
    weight = weight * (cosine > GRAZING) * cosine.clamp(min=0.0)
    weight = weight * ((weight > 0).sum(dim=0) >= 3)
    along, square, _ = _gloss_normal_equations(
        reflectance.diffuse(cosine), gloss_lobe(cosine, reflectance.alpha), response, weight
    )
    return along, square


def _gloss_normal_equations(
    diffuse: torch.Tensor, lobe: torch.Tensor, response: torch.Tensor, weight: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Sides of each point's equation for f0 [P], and response and lobe [K, P] without their diffuse part."""
    robust = weight
    for _ in range(_ITERATIONS):
        weighted = robust * diffuse
        norm = (weighted * diffuse).sum(dim=0).clamp(min=1e-9)
        response_left = response - diffuse * ((weighted * response).sum(dim=0) / norm)
        lobe_left = lobe - diffuse * ((weighted * lobe).sum(dim=0) / norm)
        along = (robust * response_left * lobe_left).sum(dim=0)
        square = (robust * lobe_left**2).sum(dim=0)
        own = (along / square.clamp(min=1e-9)).clamp(min=0.0)
        residual = (response_left - own * lobe_left) / _SCALE
        robust = weight / (1.0 + residual**2)
    return along, square, (response_left, lobe_left)
