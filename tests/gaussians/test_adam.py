"""Adam without PyTorch's compiler: the same bits as torch.optim's, tensor by tensor."""

from __future__ import annotations

import subprocess
import sys

import torch
from torch import nn

from splashbench.gaussians.adam import Adam


def test_it_gives_the_bits_of_torch_optim() -> None:
    torch.manual_seed(0)
    ours = [nn.Parameter(torch.randn(shape)) for shape in ((7, 3), (40,), (2, 3, 4), (0, 5))]
    theirs = [nn.Parameter(p.detach().clone()) for p in ours]
    own = Adam([{"params": ours[:2], "lr": 0.01}, {"params": ours[2:], "lr": 0.003}], eps=1e-15)
    oracle = torch.optim.Adam(
        [{"params": theirs[:2], "lr": 0.01}, {"params": theirs[2:], "lr": 0.003}], eps=1e-15, fused=True
    )
    for step in range(30):
        for a, b in zip(ours, theirs):
            if step % 3 or a.ndim != 1:  # one that has no gradient now and then
                a.grad = torch.randn(a.shape)
                b.grad = a.grad.clone()
        for optimizer in (own, oracle):
            optimizer.param_groups[0]["lr"] = 0.01 / (1 + step)
            optimizer.step()
            optimizer.zero_grad()
        assert all(a.grad is None for a in ours)
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs))
    for a, b in zip(ours, theirs):
        for key in ("step", "exp_avg", "exp_avg_sq"):
            assert torch.equal(own.state[a][key], oracle.state[b][key])


def test_it_does_not_load_the_compiler() -> None:
    program = """
import sys, torch
from splashbench.gaussians.adam import Adam
x = torch.nn.Parameter(torch.ones(3))
adam = Adam([{"params": [x], "lr": 0.1}])
x.sum().backward()
adam.step()
assert x[0] < 1
print("torch._dynamo" in sys.modules)
"""
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"
