"""The optimizers Muon and Adam, compared with their publications."""

import numpy as np
import pytest
import torch

from dmrl.learn.networks.architectures import build_network
from dmrl.learn.training.optimizer import Muon, build_optimizer, orthogonalize


@pytest.mark.parametrize("shape", [(48, 48), (48, 32), (32, 144)])
def test_orthogonalized_updates_have_similar_singular_values(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    u, _, v = torch.linalg.svd(torch.randn(shape), full_matrices=False)
    before = torch.logspace(0, -2, min(shape))
    after = orthogonalize(u @ torch.diag(before) @ v)
    torch.testing.assert_close(u.T @ after @ v.T, torch.diag((u.T @ after @ v.T).diagonal()))
    sizes = torch.linalg.svdvals(after)
    assert float(sizes.min()) > 0.6
    assert float(sizes.max()) < 1.3


@pytest.mark.heavy
def test_muon_takes_the_kernels_that_mix_channels() -> None:
    network = build_network("dmrl-nano")
    optimizer = build_optimizer(network, "muon", 0.01)
    assert isinstance(optimizer, Muon)
    mixing = {id(p) for p in optimizer.param_groups[0]["params"]}
    names = [name for name, p in network.named_parameters() if id(p) in mixing]
    assert len(names) == 9
    assert "body.1.0.weight" in names  # This is the second convolution.
    assert not {"body.0.0.weight", "body.2.depthwise.0.weight", "head.weight"} & set(names)
    every = [p for group in optimizer.param_groups for p in group["params"]]
    assert {id(p) for p in every} == {id(p) for p in network.parameters()}
    assert len(every) == len(list(network.parameters()))


@pytest.mark.heavy
def test_a_step_of_muon_is_as_large_as_one_of_adam_and_downhill() -> None:
    sizes = {}
    for name in ("adam", "muon"):
        network = build_network("dmrl-nano", seed=3)
        optimizer = build_optimizer(network, name, 0.01)  # type: ignore[arg-type]
        kernel = network.get_parameter("body.5.0.weight")
        before = kernel.detach().clone()
        torch.manual_seed(1)
        loss = (network(torch.randn(2, 3, 32, 32)) ** 2).sum()
        loss.backward()  # type: ignore[no-untyped-call]
        assert kernel.grad is not None
        gradient = kernel.grad.clone()
        for group in optimizer.param_groups:
            group["lr"] = 1e-3
        optimizer.step()
        moved = kernel.detach() - before
        assert float((moved * gradient).sum()) < 0
        sizes[name] = float(moved.square().mean().sqrt())
    assert 0.1 < sizes["muon"] / sizes["adam"] < 1.0


def test_adam_is_used_without_weight_decay_and_adamw_with_it() -> None:
    assert type(build_optimizer(build_network("locanet"), "adam", 0.0)) is torch.optim.Adam
    assert type(build_optimizer(build_network("locanet"), "adam", 0.1)) is torch.optim.AdamW


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_only_kernels_decay(name: str) -> None:
    network = build_network("dmrl-nano")
    groups = build_optimizer(network, name, 0.01).param_groups  # type: ignore[arg-type]
    decays = {id(p): group["weight_decay"] for group in groups for p in group["params"]}
    for parameter in network.parameters():
        assert decays[id(parameter)] == (0.01 if parameter.ndim > 1 else 0.0)


def orthogonalize_plainly(matrix: np.ndarray) -> np.ndarray:
    """Run the published iteration on a matrix that is not taller than wide."""
    x = matrix / np.linalg.norm(matrix)
    for _ in range(5):
        square = x @ x.T
        x = 3.4445 * x + (-4.7750 * square + 2.0315 * square @ square) @ x
    return x


def test_muon_steps_equal_the_published_algorithm_and_others_use_adam() -> None:
    torch.manual_seed(2)
    rate, decay = 0.02, 0.1
    kernel = torch.nn.Parameter(torch.randn(4, 3, 3, 3))
    other, plain = (torch.nn.Parameter(torch.linspace(-1, 1, 6)) for _ in range(2))
    muon = Muon(
        [
            {"params": [kernel], "weight_decay": decay, "mixing": True, "lr": rate},
            {"params": [other], "weight_decay": 0.0, "mixing": False, "lr": rate},
        ]
    )
    adam = torch.optim.AdamW([plain], lr=rate, weight_decay=0.0, eps=1e-7)
    wanted, momentum = kernel.detach().numpy().copy().reshape(4, 27), np.zeros((4, 27))
    for _ in range(3):
        gradient = torch.randn(4, 3, 3, 3)
        flat = gradient.numpy().reshape(4, 27)
        kernel.grad, other.grad, plain.grad = gradient.clone(), torch.ones(6), torch.ones(6)
        muon.step()
        adam.step()
        momentum = 0.95 * momentum + 0.05 * flat
        update = orthogonalize_plainly(0.05 * flat + 0.95 * momentum)
        wanted = wanted * (1 - rate * decay) - rate * 0.2 * 27**0.5 * update
        assert kernel.detach().numpy().reshape(4, 27) == pytest.approx(wanted, abs=1e-5)
        assert kernel.grad is None
        torch.testing.assert_close(other, plain)
    assert muon.state[kernel]["step"] == 0


@pytest.mark.parametrize(("rows", "columns"), [(3, 5), (5, 3), (4, 4), (1, 7)])
def test_orthogonalize_wide_and_tall_matrices(rows: int, columns: int) -> None:
    matrix = np.random.default_rng(rows).normal(size=(rows, columns)).astype(np.float32)
    lying = matrix.T if rows > columns else matrix
    wanted = orthogonalize_plainly(lying)
    found = orthogonalize(torch.from_numpy(matrix)).numpy()
    assert (found.T if rows > columns else found) == pytest.approx(wanted, abs=1e-4)


def test_the_epsilon_of_adam_is_the_published_one() -> None:
    for name, decay in (("adam", 0.0), ("adam", 0.1), ("muon", 0.1)):
        optimizer = build_optimizer(build_network("dmrl-nano"), name, decay)  # type: ignore[arg-type]
        assert {group["eps"] for group in optimizer.param_groups} == {1e-7}
