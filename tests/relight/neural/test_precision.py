"""Products are rounded to bfloat16 where it is asked for and the device has instructions for it, else not."""

import pytest
import torch

from relight.neural import precision

CPU = torch.device("cpu")


def product(kind):
    """A product whose exact value bfloat16 cannot hold."""
    with precision.products_in(kind, CPU):
        return torch.full((1, 1), 1.0 + 2.0**-10) @ torch.ones(1, 1)


@pytest.mark.parametrize(
    ("kind", "instructions", "expected"),
    [
        ("float32", {"avx512_bf16": True}, torch.float32),
        ("bfloat16", {"avx512_bf16": True}, torch.bfloat16),
        ("bfloat16", {"amx_bf16": True}, torch.bfloat16),
        ("bfloat16", {"avx512_f": True, "avx512_bf16": False}, torch.float32),
        ("bfloat16", {}, torch.float32),
    ],
)
def test_the_device_decides_with_what_is_asked(monkeypatch, kind, instructions, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: instructions)
    result = product(kind)
    assert result.dtype == expected
    assert (float(result) == 1.0) == (expected == torch.bfloat16)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA card")
def test_a_card_is_asked_itself():
    card = torch.device("cuda")
    assert precision.has_bfloat16(card) == torch.cuda.is_bf16_supported(including_emulation=False)
