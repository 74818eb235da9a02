"""Expansion of recipe tables into steps."""

import tomllib
from typing import Any

import pytest

from dmrl.guards import limits
from dmrl.pipeline.recipe_language import expand_steps


def expand_valid(text: str) -> list[dict[str, Any]]:
    """Expand a recipe and assert that it has no faults."""
    faults: list[str] = []
    found = expand_steps(tomllib.loads(text), faults)
    assert not faults
    return [step for _, step in found]


def find_faults(text: str) -> list[str]:
    """Return the faults of a recipe."""
    found: list[str] = []
    expand_steps(tomllib.loads(text), found)
    return found


FLIGHTS = """
step = [
  { stage = "fly", seed = "{flight}", title = "no. {flight}", out = "flight-{flight}.mcap" },
  { stage = "dataset", recordings = ["own.mcap", "flight-{flight}.mcap"], out = "all" },
]
[each]
"""


@pytest.mark.parametrize("values", ['"3-5"', "[3, 4, 5]"])
def test_placeholder_in_out_repeats_a_step_and_in_inputs_lists_all_values(values: str) -> None:
    assert expand_valid(FLIGHTS + f"flight = {values}") == [
        *[
            {"stage": "fly", "seed": n, "title": f"no. {n}", "out": f"flight-{n}.mcap"}
            for n in (3, 4, 5)
        ],
        {
            "stage": "dataset",
            "recordings": ["own.mcap", *[f"flight-{n}.mcap" for n in (3, 4, 5)]],
            "out": "all",
        },
    ]


ROUNDS = """
step = [
  { stage = "train", epochs = "{round.epochs}", dataset = "{round.of}", out = "model-{round.k}" },
  { stage = "predict", model = "model-{round.before}", out = "seen-{round.k}-{robot}" },
]
[each]
robot = ["cf1", "cf2"]
round = [{ k = 1, of = "flown" }, { k = "last", before = 1, epochs = 4, of = "seen" }]
[defaults]
train = { epochs = 8, seed = 5 }
"""


def test_rows_set_values_and_missing_values_drop_keys_or_steps() -> None:
    train, predict = {"stage": "train", "seed": 5}, {"stage": "predict", "model": "model-1"}
    assert expand_valid(ROUNDS) == [
        {**train, "epochs": 8, "dataset": "flown", "out": "model-1"},
        {**train, "epochs": 4, "dataset": "seen", "out": "model-last"},
        {**predict, "out": "seen-last-cf1"},
        {**predict, "out": "seen-last-cf2"},
    ]


def test_data_placeholder_is_kept_and_values_are_not_expanded_again() -> None:
    (step,) = expand_valid(
        'step = [{ stage = "convert", source = "{data}/{log}.csv", out = "a" }]\n'
        '[each]\nlog = ["{data}"]'
    )
    assert step["source"] == ["{data}/{data}.csv"]


ONE = 'step = [{ stage = "fly", out = "f-{a}", seed = "{a}" }]\n[each]\n'


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (ONE + "a = 3", "each.a: must be a range"),
        (ONE + "a = true", "each.a: must be a range"),
        (ONE + "a = []", "each.a: must be a range"),
        (ONE + 'a = "5-3"', "each.a: 5-3 runs backwards"),
        (ONE + 'a = "001-144"', "each.a: must be a range"),
        (ONE + "a = [1, 1]", "each.a: has a value twice"),
        (ONE + "a = [1, { k = 1 }]", "each.a: must hold numbers, texts, or tables"),
        (ONE + "a = [[1]]", "each.a: must hold"),
        (ONE + 'a = "1-2"\nb = "1-2"', "each.b: no step names {b}"),
        (ONE + 'a = "1-2"\ndata = "1-2"', "each.data: cannot be a name"),
        (ONE + 'ab = "1-2"', "step.1.out: no a in [each]"),
        (ONE + "a = [{ k = 1 }]", "step.1.out: {a} has rows"),
        (ONE.replace("f-{a}", "f-{a.k}") + "a = [1]", "step.1.out: {a.k}: a has no rows"),
        (ONE.replace("{a}", "{a.j}") + "a = [{ k = 1 }]", "step.1.out: no row of a has j"),
        (ONE.replace("{a}", "{a.k}") + "a = [{ k = 1, epohcs = 2 }]", "each.a.epohcs: no step"),
        (ONE + 'a = "1-2"\n[defaults.train]\nseed = 1', "defaults.train: no step is of that"),
        ("each = 3", "each: must be a table"),
        ("defaults = 3", "defaults: must hold a table"),
        ("", "step: at least one [[step]] is required"),
        ("step = 3", "step: at least one"),
        ("step = [3]", "step.1: must be a table"),
        ('step = [{ stage = "fly" }]', "step.1.out: a text is required"),
    ],
)
def test_invalid_recipe_is_a_fault(text: str, fault: str) -> None:
    assert any(found.startswith(fault) for found in find_faults(text)), find_faults(text)


MANY = '"1-9999"'
TWO, THREE = f"[each]\na = {MANY}\nb = {MANY}\n", f"[each]\na = {MANY}\nb = {MANY}\nc = {MANY}\n"
HUGE = [
    ONE + "a = 100000000",
    ONE + 'a = "1-100000000"',
    ONE + f"a = [{', '.join(map(str, range(limits.STEPS + 1)))}]",
    'step = [{ stage = "fly", out = "{a}{b}{c}" }]\n' + THREE,
    'step = [{ stage = "merge", out = "m", recordings = "{a}{b}" }]\n' + TWO,
    'step = [{ stage = "merge", out = "m{a}", recordings = "{b}" }]\n' + TWO,
    f'step = [{{ stage = "fly", out = "{{a}}", x = "{"x" * 100_000}" }}]\n{ONE[-7:]}a = {MANY}',
]


@pytest.mark.parametrize("text", HUGE)
def test_oversized_recipe_is_not_expanded(text: str) -> None:
    found: list[str] = []
    assert not expand_steps(tomllib.loads(text), found)
    assert found
