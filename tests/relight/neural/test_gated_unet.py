"""The rendering network is the gated U-Net that it says it is, by a computation in plain numpy."""

import numpy as np
import pytest
import torch
from torch import nn

from relight.neural.gated_unet import GatedConv, GatedUNet

RANDOM = np.random.default_rng(0)


def convolved(x, weight, bias):
    """[C, H, W] with zeros beyond the edge, one output pixel after the other."""
    out, _, size, _ = weight.shape
    reach = size // 2
    padded = np.pad(x, ((0, 0), (reach, reach), (reach, reach)))
    result = np.empty((out, *x.shape[1:]))
    for row in range(x.shape[1]):
        for column in range(x.shape[2]):
            window = padded[:, row : row + size, column : column + size]
            result[:, row, column] = (weight * window).sum(axis=(1, 2, 3)) + bias
    return result


def gated(block, x):
    """A gated convolution of [C, H, W] as it stands: leaky features times their gate, then normalised."""
    both = convolved(x, block.conv.weight.numpy(), block.conv.bias.numpy())
    features, gate = both[: block.channels_out], both[block.channels_out :]
    result = np.where(features > 0, features, 0.2 * features) / (1.0 + np.exp(-gate))
    if block.norm is None:
        return result
    scale, shift = (values.numpy()[:, None, None] for values in (block.norm.weight, block.norm.bias))
    return (result - result.mean(axis=0)) / np.sqrt(result.var(axis=0) + block.norm.eps) * scale + shift


def halved(x):
    return x.reshape(len(x), x.shape[1] // 2, 2, x.shape[2] // 2, 2).mean(axis=(2, 4))


def doubled(x):
    """Bilinear interpolation at twice the size, pixel centres at 0.5, edges repeated."""
    for axis in (1, 2):
        size = x.shape[axis]
        place = np.clip((np.arange(2 * size) + 0.5) / 2 - 0.5, 0, size - 1)
        low = np.floor(place).astype(int)
        share = (place - low).reshape([-1 if a == axis else 1 for a in range(3)])
        high = np.minimum(low + 1, size - 1)
        x = np.take(x, low, axis) * (1 - share) + np.take(x, high, axis) * share
    return x


def random_network(normalised=True):
    """Three scales, float64, with scales and shifts as after some training."""
    torch.manual_seed(0)
    network = GatedUNet([2, 3, 2], 4, [4, 6, 8], normalised=normalised).double().eval()
    for module in network.modules():
        if isinstance(module, nn.LayerNorm):
            nn.init.normal_(module.weight)
            nn.init.normal_(module.bias)
    return network.requires_grad_(False)


def raws_of(size=8):
    return [RANDOM.normal(size=(c, size >> t, size >> t)) for t, c in enumerate((2, 3, 2))]


@pytest.mark.parametrize("normalised", [True, False])
def test_the_network_is_what_it_says_by_a_plain_computation(normalised):
    network, raws = random_network(normalised), raws_of()
    found = network([torch.from_numpy(raw)[None] for raw in raws])[0].numpy()
    first = gated(network.start, raws[0])
    second = np.concatenate([gated(network.down[0], halved(first)), raws[1]])
    third = np.concatenate([gated(network.down[1], halved(second)), raws[2]])
    x = third
    for scale, beside in ((1, second), (0, first)):
        up = network.up[scale]
        x = convolved(doubled(x), up.weight.numpy(), up.bias.numpy())
        x = gated(network.merge[scale], np.concatenate([x, beside]))
    expected = convolved(x, network.last.weight.numpy(), network.last.bias.numpy())
    # Both in float64: sums of some hundred terms in another order.
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_closed_gate_lets_nothing_through():
    block = GatedConv(1, 2, normalised=False)
    nn.init.zeros_(block.conv.weight)
    block.conv.bias.data = torch.tensor([3.0, -3.0, -200.0, -200.0])
    assert not block(torch.ones(1, 1, 4, 4)).any()


def test_every_raw_image_reaches_the_output():
    network, raws = random_network(), raws_of()
    inputs = [torch.from_numpy(raw)[None].requires_grad_(True) for raw in raws]
    network(inputs).sum().backward()
    assert all(float(raw.grad.abs().min()) > 0 for raw in inputs)


def test_gradients_are_those_of_finite_differences():
    network = random_network()
    inputs = [torch.from_numpy(raw)[None].requires_grad_(True) for raw in raws_of(4)]
    assert torch.autograd.gradcheck(lambda *raws: network(raws), inputs)


def test_the_papers_network_has_as_many_parameters_as_that_of_neural_point_based_graphics():
    network = GatedUNet([8] * 5, 8, [16, 32, 64, 128, 256])
    assert sum(parameter.numel() for parameter in network.parameters()) == 1_929_336
    assert network.scales == 5
    assert not any(isinstance(module, nn.ConvTranspose2d) for module in network.modules())


def test_the_output_is_as_large_as_the_finest_raw_image():
    network = GatedUNet([8] * 5, 8, [16, 32, 64, 128, 256]).eval()
    raws = [torch.zeros(2, 8, 32 >> t, 48 >> t) for t in range(5)]
    assert network(raws).shape == (2, 8, 32, 48)


def test_widths_that_leave_no_room_for_the_raw_images_are_refused():
    with pytest.raises(ValueError, match="do not fit"):
        GatedUNet([8, 8], 8, [16, 8])
    with pytest.raises(ValueError, match="do not fit"):
        GatedUNet([8, 8], 8, [16])
