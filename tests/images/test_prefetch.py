"""Work done ahead in threads: ordered results, errors in turn, a bounded number of items."""

import pytest

from dmrl.images.prefetch import map_ahead


@pytest.mark.parametrize("threads", [1, 3])
def test_results_come_in_the_order_of_the_items(threads: int) -> None:
    assert list(map_ahead(lambda k: k * k, range(50), threads)) == [k * k for k in range(50)]


def test_error_is_raised_in_the_order_of_its_item() -> None:
    results = map_ahead(lambda k: 10 // (3 - k), range(6), 2)
    assert [next(results) for _ in range(3)] == [3, 5, 10]
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_number_of_items_taken_ahead_is_bounded() -> None:
    taken: list[int] = []
    results = map_ahead(lambda k: k, (taken.append(k) or k for k in range(100)), 2, max_waiting=3)
    assert next(results) == 0
    assert len(taken) == 7
