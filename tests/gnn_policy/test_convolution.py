"""The convolution is PyTorch's own, forward and backward, for maps of every size and in both precisions."""

import pytest
import torch
from torch import nn

from gnn_policy import convolution
from gnn_policy.convolution import StridedConvolution


def pair(in_channels, out_channels):
    torch.manual_seed(in_channels)
    ours, reference = StridedConvolution(in_channels, out_channels), nn.Conv2d(in_channels, out_channels, 3, 2, 1)
    reference.load_state_dict(ours.state_dict())
    return ours, reference


@pytest.mark.parametrize("height", range(1, 8))
@pytest.mark.parametrize("width", [1, 2, 5, 6])
@pytest.mark.parametrize("layout", [torch.channels_last, torch.contiguous_format])
def test_results_and_gradients_are_those_of_the_library(height, width, layout):
    ours, reference = pair(3, 4)
    maps = torch.randn(5, 3, height, width).to(memory_format=layout)
    mine, known = (maps.clone().requires_grad_() for _ in range(2))
    result, expected = ours(mine), reference(known)
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-5)
    upper = torch.randn_like(expected)
    result.backward(upper)
    expected.backward(upper)
    torch.testing.assert_close(mine.grad, known.grad, rtol=1e-5, atol=1e-5)
    for weights, others in zip(ours.parameters(), reference.parameters(), strict=True):
        torch.testing.assert_close(weights.grad, others.grad, rtol=1e-4, atol=1e-5)


def test_gradients_are_those_of_finite_differences():
    convolution = StridedConvolution(2, 3).double()
    maps = torch.randn(2, 2, 5, 4, dtype=torch.float64, requires_grad=True)
    torch.autograd.gradcheck(convolution, (maps,))


def test_under_autocast_it_computes_in_bfloat16_and_its_weights_stay_float32():
    ours, reference = pair(8, 16)
    maps = torch.randn(4, 8, 6, 6, requires_grad=True)
    with torch.autocast("cpu", torch.bfloat16):
        result = ours(maps)
    assert result.dtype == torch.bfloat16
    torch.testing.assert_close(result.float(), reference(maps), rtol=0.05, atol=0.05)
    result.float().sum().backward()
    assert maps.grad is not None
    assert {maps.grad.dtype, *(each.grad.dtype for each in ours.parameters() if each.grad is not None)} == {
        torch.float32
    }


def test_off_the_cpu_the_librarys_own_convolution_computes(monkeypatch):
    """Shown on the meta device, which has shapes alone: no product of matrices is asked for there."""

    def products(*_):
        raise AssertionError("matrix products are for CPUs")

    monkeypatch.setattr(convolution._Products, "apply", products)
    ours = StridedConvolution(3, 4).to("meta")
    result = ours(torch.empty(5, 3, 7, 6, device="meta"))
    assert result.shape == (5, 4, 4, 3)
    assert result.device.type == "meta"
    with pytest.raises(AssertionError, match="for CPUs"):
        StridedConvolution(3, 4)(torch.empty(5, 3, 7, 6))


def test_weights_begin_as_those_of_the_library():
    torch.manual_seed(0)
    ours, reference = StridedConvolution(16, 256), nn.Conv2d(16, 256, 3, 2, 1)
    for mine, known in zip(ours.parameters(), reference.parameters(), strict=True):
        assert mine.shape == known.shape
        assert mine.std().item() == pytest.approx(known.std().item(), rel=0.1)
        assert mine.abs().max().item() <= 1 / 12
