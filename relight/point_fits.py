"""Robust least squares of every point by itself: its normal and its albedo from the flash frames."""

from __future__ import annotations

import torch

from relight.flash_part import BLACK, ITERATIONS, FlashPart
from relight.reflectance import GRAZING, Reflectance


def fit_normals(
    flash: FlashPart, prior: torch.Tensor, reflectance: Reflectance, prior_weight: float, relative: float
) -> torch.Tensor:
    """Unit normals [P, 3], the prior where nothing was observed or the result strays over 45 degrees."""
    response = flash.response.mean(dim=-1)
    normals = prior
    tangential = torch.eye(3).to(prior) - prior[:, :, None] * prior[:, None, :]
    for _ in range(ITERATIONS - 1):
        cosine = flash.cosine(normals)
        diffuse = reflectance.diffuse(cosine)
        # diffuse(c) = gain c: with the gain of the last normal the model is linear in b = albedo n.
        gain = diffuse / cosine.clamp(min=1e-3)
        matte = response - reflectance.gloss(cosine) * flash.gloss
        weight = flash.weight * (cosine > GRAZING) * cosine
        albedo = (weight * diffuse * matte).sum(dim=0) / (weight * diffuse**2).sum(dim=0).clamp(min=1e-6)
        deviation = (matte - albedo * diffuse) / (relative * albedo.abs() + BLACK)
        weight = weight / (1.0 + (0.5 * deviation) ** 2)
        weighted = (weight * gain**2)[..., None] * flash.to_light
        left = torch.einsum("kpi,kpj->pij", weighted, flash.to_light) + prior_weight * tangential
        left = left + 1e-4 * torch.eye(3).to(left)
        right = ((weight * gain * matte)[..., None] * flash.to_light).sum(dim=0) + 1e-4 * albedo[
            :, None
        ] * prior
        b = torch.linalg.solve(left.double(), right.double()).to(prior)
        fitted = b / torch.linalg.vector_norm(b, dim=1, keepdim=True).clamp(min=1e-12)
        sane = ((fitted * prior).sum(dim=1) > 0.7) & (albedo > BLACK)
        normals = torch.where(sane[:, None], fitted, prior)
    return normals


def fit_albedo(
    flash: FlashPart, normals: torch.Tensor, reflectance: Reflectance, relative: float | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Albedo [P, C], information [P], relative residual [P] and standard error [P]; without `relative` not
    robust."""
    cosine = flash.cosine(normals)
    diffuse = reflectance.diffuse(cosine)
    matte = flash.response - (reflectance.gloss(cosine) * flash.gloss)[..., None]
    weight = flash.weight * (cosine > GRAZING) * cosine.clamp(min=0.0)
    robust = weight
    for iteration in range(ITERATIONS if relative is not None else 1):
        information = (robust * diffuse**2).sum(dim=0)
        albedo = ((robust * diffuse)[..., None] * matte).sum(dim=0) / information.clamp(min=1e-6)[:, None]
        deviation = (matte - albedo * diffuse[..., None]).mean(dim=-1)
        if relative is not None and iteration + 1 < ITERATIONS:
            spread = relative * albedo.mean(dim=-1).abs() + BLACK
            robust = weight / (1.0 + (0.5 * deviation / spread) ** 2)
    frames = (weight > 0).sum(dim=0)
    variance = (weight * deviation**2).sum(dim=0) / weight.sum(dim=0).clamp(min=1e-6)
    variance = variance * frames / (frames - 1).clamp(min=1)
    residual = variance.sqrt() / (albedo.mean(dim=-1).abs() + BLACK)
    if relative is not None:  # few frames say little of their own spread: the subject's counts as one more
        usual = relative * albedo.mean(dim=-1).abs() + BLACK
        variance = ((frames - 1).clamp(min=0) * variance + usual**2) / frames.clamp(min=1)
    return albedo, information, residual, (variance / information.clamp(min=1e-6)).sqrt().clamp(max=1.0)
