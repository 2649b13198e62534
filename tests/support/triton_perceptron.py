"""The CUDA twin of the perceptron against its reference, on a GPU or through triton's interpreter.

Whole numbers so small that every sum is exact in bfloat16, whichever way somebody rounds: the two must be equal.
"""

from itertools import pairwise

import torch

from nerf_lightning.nerf.kernels.mlp.op import mlp_torch

SIZES = [(32, 64, 16), (32, 64, 64, 3), (20, 40, 24, 5), (16, 16, 1)]


def _weight(outer, inner, generator):
    """Two ones or minus ones a row, and zeros: sums at most double from layer to layer."""
    weight = torch.zeros(outer, inner)
    for row in weight:
        row[torch.randperm(inner, generator=generator)[:2]] = torch.tensor([1.0, -1.0])
    return weight


def check_perceptron(device, counts):
    from nerf_lightning.nerf.kernels.mlp import cuda as backend

    backend.trial(device)
    generator = torch.Generator().manual_seed(7)
    for sizes in SIZES:
        assert backend.takes(sizes, torch.device(device))
        weights = [_weight(outer, inner, generator).to(device) for inner, outer in pairwise(sizes)]
        for count in counts:
            points = torch.randint(-3, 4, (count, sizes[0]), generator=generator).float().to(device)
            grad = torch.randint(-1, 2, (count, sizes[-1]), generator=generator).float().to(device)
            leaves = [each.clone().requires_grad_() for each in (points, *weights)]
            expected = mlp_torch(leaves[0], leaves[1:])
            expected.backward(grad)
            out, kept = backend.forward(points, weights, keep=True)
            of_points, of_weights = backend.backward(grad, weights, kept, wants_points=True)
            assert torch.equal(out, expected.detach()), (sizes, count)
            for found, leaf in zip((of_points, *of_weights), leaves, strict=True):
                assert torch.equal(found, leaf.grad), (sizes, count, found.shape)
            assert torch.equal(backend.forward(points, weights, keep=False)[0], out)
            assert backend.backward(grad, weights, kept, wants_points=False)[0] is None
            for padding in (0, 1, 150, 640):
                check_padding(backend, points, grad, weights, max(0, count - padding))
    assert not backend.takes((32, 3), torch.device(device))
    assert not backend.takes((32, 256, 3), torch.device(device))


def check_padding(backend, points, grad, weights, rows):
    """Rows after the first ones, of zeros, are left out, whatever memory holds where nothing is computed."""
    used = torch.full((1,), rows, device=points.device)
    points, grad = (each.clone() for each in (points, grad))
    points[rows:], grad[rows:] = 0.0, 0.0
    out, kept = backend.forward(points, weights, True, used)
    expected, all_kept = backend.forward(points, weights, keep=True)
    assert torch.equal(out, expected)
    computed = -(-rows // backend.BLOCK) * backend.BLOCK
    kept[computed:] = torch.nan
    found = backend.backward(grad, weights, kept, True, used)
    expected = backend.backward(grad, weights, all_kept, True)
    assert torch.equal(found[0], expected[0])
    assert all(map(torch.equal, found[1], expected[1]))
