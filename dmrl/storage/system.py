"""Open fsspec file systems, and turn their errors into one line with a way out."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from dmrl.errors import MissingExtra, StorageError

SCHEME_PACKAGES = {"s3": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "az": "adlfs", "abfs": "adlfs"}
"""Package that each scheme needs."""


@cache
def get_filesystem(scheme: str) -> Any:
    """Return the file system of a scheme, without a cache of listings.

    Raises
    ------
    MissingExtra
        If the package for the scheme is not installed.
    """
    try:
        import fsspec  # noqa: PLC0415 - an extra

        if scheme == "s3":  # imported here, as it needs packages of the same extra
            from dmrl.storage.bucket import BucketFileSystem  # noqa: PLC0415

            return BucketFileSystem(use_listings_cache=False, skip_instance_cache=True)
        return fsspec.filesystem(scheme, use_listings_cache=False)
    except ImportError as e:
        raise MissingExtra(SCHEME_PACKAGES[scheme], "storage", f"{scheme}://") from e


@contextmanager
def translate_errors(name: str) -> Iterator[None]:
    """Turn errors of a server or its library into one line; pass on missing files.

    Raises
    ------
    StorageError
        If the server cannot be reached or refuses, or the bucket does not exist.
    FileNotFoundError
        If the file does not exist in the bucket.
    """
    try:
        yield
    except (StorageError, MissingExtra):
        raise
    except FileNotFoundError as e:
        if "bucket" in str(e).lower():
            raise StorageError(f"{name}: there is no such bucket. Check the name") from None
        raise FileNotFoundError(2, "No such file", name) from None
    except PermissionError:
        raise StorageError(
            f"{name}: the server refuses these credentials. Check them, and the name"
        ) from None
    except Exception as e:  # botocore, aiohttp and google define their own classes
        raise StorageError(_describe_error(name, e)) from e


def _describe_error(name: str, error: Exception) -> str:
    kind, text = type(error).__name__, " ".join(str(error).split())[:160]
    if "Credential" in kind or "credential" in text:
        return f"{name}: there are no credentials ({text}). Set AWS_ACCESS_KEY_ID and its secret"
    if "Connect" in kind or "Endpoint" in kind or isinstance(error, TimeoutError):
        return f"{name}: no server answers ({text}). Check the address: AWS_ENDPOINT_URL"
    return f"{name}: {kind}: {text}. Check the name, and the server"
