import pytest
import torch

from dmrl.learn.network import build
from dmrl.learn.optimizer import Muon, new_optimizer, orthogonal


@pytest.mark.parametrize("shape", [(48, 48), (48, 32), (32, 144)])
def test_every_direction_of_an_update_is_of_about_the_same_size(shape: tuple[int, int]) -> None:
    torch.manual_seed(0)
    u, _, v = torch.linalg.svd(torch.randn(shape), full_matrices=False)
    before = torch.logspace(0, -2, min(shape))
    after = orthogonal(u @ torch.diag(before) @ v)
    torch.testing.assert_close(u.T @ after @ v.T, torch.diag((u.T @ after @ v.T).diagonal()))
    sizes = torch.linalg.svdvals(after)
    assert float(sizes.min()) > 0.6
    assert float(sizes.max()) < 1.3


def test_muon_takes_the_kernels_that_mix_channels() -> None:
    network = build("dmrl-nano")
    optimizer = new_optimizer(network, "muon", 0.01)
    assert isinstance(optimizer, Muon)
    mixing = {id(p) for p in optimizer.param_groups[0]["params"]}
    names = [name for name, p in network.named_parameters() if id(p) in mixing]
    assert len(names) == 9
    assert "body.1.0.weight" in names  # the second convolution
    assert not {"body.0.0.weight", "body.2.depthwise.0.weight", "head.weight"} & set(names)
    every = [p for group in optimizer.param_groups for p in group["params"]]
    assert {id(p) for p in every} == {id(p) for p in network.parameters()}
    assert len(every) == len(list(network.parameters()))


def test_a_step_of_muon_is_as_large_as_one_of_adam_and_downhill() -> None:
    sizes = {}
    for name in ("adam", "muon"):
        network = build("dmrl-nano", seed=3)
        optimizer = new_optimizer(network, name, 0.01)  # type: ignore[arg-type]
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


def test_without_weight_decay_adam_is_the_papers() -> None:
    assert type(new_optimizer(build("locanet"), "adam", 0.0)) is torch.optim.Adam
    assert type(new_optimizer(build("locanet"), "adam", 0.1)) is torch.optim.AdamW


@pytest.mark.parametrize("name", ["adam", "muon"])
def test_only_kernels_decay(name: str) -> None:
    network = build("dmrl-nano")
    groups = new_optimizer(network, name, 0.01).param_groups  # type: ignore[arg-type]
    decays = {id(p): group["weight_decay"] for group in groups for p in group["params"]}
    for parameter in network.parameters():
        assert decays[id(parameter)] == (0.01 if parameter.ndim > 1 else 0.0)
