"""Images to learn from."""

import pytest

from dmrl.learn.data.batches import Examples

from .fitting import dots


@pytest.fixture
def examples() -> Examples:
    return dots(20)
