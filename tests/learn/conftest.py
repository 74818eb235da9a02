"""A set of images that several training tests learn from."""

import pytest

from dmrl.learn.data.batches import ExampleSet

from .fitting import draw_dots


@pytest.fixture
def examples() -> ExampleSet:
    """Return 20 images of a labelled bright square."""
    return draw_dots(20)
