"""The CPU cores shown to Blender's libraries while they load."""

import os

import pytest

from dmrl.rendering.blender.core import limit_to_one_core


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="cores cannot be chosen here")
def test_one_core_is_visible_inside_and_all_of_them_afterwards() -> None:
    before = os.sched_getaffinity(0)
    with pytest.raises(ImportError), limit_to_one_core():
        assert len(os.sched_getaffinity(0)) == 1
        raise ImportError("no bpy")
    assert os.sched_getaffinity(0) == before


def test_systems_without_cpu_affinity_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_setaffinity", raising=False)
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    with limit_to_one_core():
        pass
