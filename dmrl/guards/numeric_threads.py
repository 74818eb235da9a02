"""One thread for linear algebra, so that a seed gives the same bytes on any number of cores.

BLAS splits a product among its threads, and the last bits of the sums depend on their number.
The threads of torch and onnxruntime are theirs: training promises its bytes for one number of
threads only.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

ONE_BLAS_THREAD = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
"""Variables that BLAS libraries of NumPy and SciPy read when they are loaded."""


def set_one_blas_thread() -> None:
    """Limit the BLAS libraries that this process and its children load from now on."""
    os.environ.update(ONE_BLAS_THREAD)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Limit the BLAS libraries, loaded or not, until the end of the block.

    A library that is loaded within the block keeps one thread.
    """
    from threadpoolctl import threadpool_limits  # noqa: PLC0415 - commands have no need for it

    before = {name: os.environ.get(name) for name in ONE_BLAS_THREAD}
    set_one_blas_thread()
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        for name, value in before.items():
            os.environ.pop(name)
            if value is not None:
                os.environ[name] = value
