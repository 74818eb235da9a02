"""Images to learn from."""

import pytest

from dmrl.learn.data.batches import ExampleSet

from .fitting import dots


@pytest.fixture
def examples() -> ExampleSet:
    return dots(20)
