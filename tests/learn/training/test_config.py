"""Training settings: their limits and defaults."""

from typing import Any

import pytest

from dmrl.learn.networks.architectures import CLASS_PREFIX, SPREAD_CHANNEL
from dmrl.learn.training.config import LIMITS, MAX_SETTING, TrainConfig
from dmrl.learn.training.losses import TERMS


def is_refused(**settings: Any) -> bool:
    """Say whether settings are refused, in one line that names the first of them."""
    try:
        TrainConfig(**settings)
    except ValueError as e:
        assert next(iter(settings)) in str(e) and "\n" not in str(e)
        return True
    return False


@pytest.mark.parametrize("name", sorted(LIMITS.keys() - {"learning_rate"}))
def test_settings_outside_their_limits_are_refused(name: str) -> None:
    """Recipes may come from others, with 2^63 images an epoch or negative shares."""
    low, high = LIMITS[name]
    above = high + 1 if high > 1 else high + 1e-9
    values = (low - 1e-9, low, high, above)
    assert [is_refused(**{name: value}) for value in values] == [True, False, False, True]


def test_limits_of_counts_shares_and_weights_are_set() -> None:
    assert (LIMITS["batch_size"][0], LIMITS["processes"]) == (1, (1, 256))
    assert (LIMITS["flip_share"], LIMITS["validation_share"]) == ((0, 1), (0, 0.5))
    assert (LIMITS["paste"], LIMITS["seed"]) == ((0, 100), (0, 2**63 - 1))
    assert {LIMITS[term.weight] for term in TERMS} == {(0, MAX_SETTING)}


def test_impossible_rates_zooms_cameras_and_shares_are_refused() -> None:
    for rate, last, wrong in (
        (1e-3, 1e-3, False),
        (1e-3, 1.001e-3, True),
        (1e-3, 0.0, False),
        (1e-3, -1e-9, True),
        (0.0, 0.0, True),
        (MAX_SETTING, 0.0, False),
        (1e308, 0.0, True),
    ):
        assert is_refused(learning_rate=rate, final_learning_rate=last) == wrong
    for zoom, wrong in (((1.0, 1.0), False), ((1.1, 1.0), True), ((0.0, 1.0), True)):
        assert is_refused(zoom=zoom) == wrong
    for intrinsics, wrong in (
        ((1.0, 1.0, -5.0, 0.0), False),
        ((0.0, 1.0, 5.0, 5.0), True),
        ((1.0, 0.0, 5.0, 5.0), True),
        ((1.0, 1.0, -1e308, 5.0), True),
    ):
        assert is_refused(intrinsics=intrinsics) == wrong
    for share, wrong in ((0.0, False), (-1e-9, True), (MAX_SETTING, False), (1e308, True)):
        assert is_refused(shares={"a": 1.0, "b": share}) == wrong


def test_extra_channels_are_the_spread_and_then_the_classes() -> None:
    assert TrainConfig().extra_channels == ()
    assert TrainConfig(spread_weight=0.1, classes=("a", "b")).extra_channels == (
        SPREAD_CHANNEL,
        f"{CLASS_PREFIX}0",
        f"{CLASS_PREFIX}1",
    )


def test_plain_epochs_disable_augmentation_at_the_end() -> None:
    settings = TrainConfig(epochs=10, plain_epochs=3, rotation_deg=5.0)
    turns = [settings.augmentation(epoch).rotation_deg for epoch in range(10)]
    assert turns == [5.0] * 7 + [0.0] * 3
    assert settings.augmentation(9).flip_share == settings.flip_share


def test_optional_settings_are_off_by_default() -> None:
    plain = TrainConfig()
    for name in (
        *("init_share", "hard_share", "paste", "plain_epochs", "frozen_norm_epochs", "grey_share"),
        *("spread_weight", "seed"),
    ):
        assert getattr(plain, name) == 0, name
    assert plain.processes == 1 and plain.threshold is None and plain.intrinsics is None
    assert (plain.confidence_weight, plain.depth_weight, plain.class_weight) == (1, 1, 1)
    # The shipped weights were trained with these.
    assert (plain.offset_weight, plain.focus) == (0.5, 2.0)


def test_defaults_equal_docs_training_md() -> None:
    plain = TrainConfig()
    assert (plain.architecture, plain.epochs) == ("dmrl-nano", 60)
    assert (plain.validation_share, plain.false_alarms) == (0.1, 0.02)
    assert (plain.optimizer, plain.label_noise, plain.precision) == ("muon", "ignore", "float32")
